"""Names of all methods, fields and regularisers, found without importing them, and endings of alignment files."""

from noiseflow.installation import Registry

ALIGNMENTS = frozenset({".json", ".xf"})
AUTO = "auto"
"""The usual method, and the choice of a field by the likelihood of held-out pixels."""

METHODS = Registry(
    "method",
    "recon.methods",
    "noiseflow.methods",
    first=AUTO,
    variants=dict.fromkeys((AUTO, "explicit", "joint-supervised", "l1", "l2", "l2-denoised", "tv"), "joint")
    | {"wbp": "sirt", "wbp-denoised": "sirt", "kniesel2022-as-published": "kniesel2022"},
)
FIELDS = Registry(
    "field",
    "recon.fields.kinds",
    "noiseflow.fields",
    first="grids",
    last=(AUTO,),
    variants={"voxels": "grids", "kniesel2022": "network"},
)
REGULARISERS = Registry(
    "regulariser",
    "recon.fields.regularisers",
    "noiseflow.regularisers",
    first="directional",
    variants={"total-variation": "second-order"},
)
"""The default is better than total variation in all of 25 scenes of 96³ (`docs/benchmarks/priors.md`)."""

method_names, field_names, regulariser_names = METHODS.names, FIELDS.names, REGULARISERS.names
