"""Changes that no test can notice, or that change nothing but speed, by file: part of a line, what of it changes, and why.

What changes is the text of the operator or number, or ``numbers``: each number of the line.
"""

from __future__ import annotations

PANELS = "how wide panels are: test_it_multiplies_as_the_dense_matrix_does takes widths from one column to all of them"
SPEED = "how much is computed at once: speed and memory only"
GUESS = (
    "where a search begins and its first steps: test_the_maximum_found_is_the_maximum finds the same maximum to a thousandth "
    "of a nat from five places, only the number of steps differs"
)
FINER = (
    "how fine a rule is that has long converged: the result is the same to more digits than any test or user asks for"
)
SAFE = "stands in where the value is not used, so that a gradient of nothing is not NaN: any ordinary number would do"
BOTH = "where one formula takes over from another: both are exact there (tested on both sides)"
WARNED = "the line of the caller that a warning names"
KIND = "of this tensor the number type and the device are taken over, nothing else (`Pixels._set_kind`)"
RNG = "seed of the package's own random choices: another seed is another, equally good choice"

LEFT_OUT: dict[str, list[tuple[str, str, str]]] = {
    "noiseflow/distributions/numerics/monotone_maps.py": [
        ("small = t < 1e-3", "numbers", BOTH),
        ("small = t < 1e-3", "t < 0.001", BOTH),
        ("torch.where(x < 0, self.left, self.right)", "x < 0", "at 0 the map is 0 with slope 1 whatever the weight"),
        ("torch.where(y < 0, self.left, self.right)", "y < 0", "at 0 the map is 0 with slope 1 whatever the weight"),
        ("torch.where(q > 0,", "q > 0", "at q = 0 both forms are the same number"),
        (
            "side = torch.where(value < low",
            "value < low",
            "at the end of the knots nothing lies beyond: the slope is not used",
        ),
    ],
    "noiseflow/distributions/numerics/normal.py": [
        ("limit: float = 12.0, count: int = 401", "numbers", FINER),
        ("flip = low > -high", "low > -high", "an interval symmetric about zero is its own mirror image"),
        ("narrow = width * (1 + middle.abs()) < 0.1", "numbers", BOTH),
        ("narrow = width * (1 + middle.abs()) < 0.1", "width * (1 + middle.abs()) < 0.1", BOTH),
    ],
    "noiseflow/distributions/noise_distribution.py": [
        ("PANELS, _TAIL = 512, 1e-10", "numbers", FINER),
        ("weights > 0, weights * values", "weights > 0", "nodes of weight 0 add 0, or nothing"),
        ("like = torch.empty(0,", "numbers", KIND),
    ],
    "noiseflow/distributions/wrappers/digitised.py": [
        (
            "if inside.shape == self.batch_shape",
            "inside.shape == self.batch_shape",
            "both ways give the same (test_clipping_alone_keeps_the_density_between_the_limits takes both shapes), one is faster",
        ),
        ("_SHARE = 64", "numbers", "from where on double precision is taken: both are exact there"),
        (
            "(steps - nearest).abs() < NEAR",
            "(steps - nearest).abs() < NEAR",
            "no level is off by exactly a thousandth",
        ),
        ("math.isfinite(edge) else 0.0", "numbers", SAFE),
        (
            "* _SHARE <= self.step",
            "torch.finfo(value.dtype).eps * float(value.detach().abs().max()) * _SHARE <= self.step",
            "from where on double precision is taken: both are exact there",
        ),
    ],
    "noiseflow/fitting/observation_table.py": [
        (
            "if self.error <= self._tolerance:",
            "self.error <= self._tolerance",
            "no measured error is the tolerance itself",
        ),
        ("worthwhile: float = 0.7", "numbers", SPEED),
        ("chunk = LONG if signal.device", "signal.device.type == 'cpu'", SPEED),
        (
            "levels = self._levels if size < len(SIZES)",
            "size < len(SIZES)",
            "the first table of residuals would be the first of levels again, which was too coarse: the next finer one is taken",
        ),
        ("math.isfinite(low + high)", "low + high", "like a sum, a difference is finite where both are"),
        ("stalled = size %", "numbers", SPEED),
        ("stalled = size %", "size % len(SIZES) > 0", SPEED),
        ("stalled = size %", "size - 1", SPEED),
        ("stalled = size %", "self.error > worthwhile * errors.get(size - 1, math.inf)", SPEED),
        ("stalled = size %", "worthwhile * errors.get(size - 1, math.inf)", SPEED),
        ("signal_low + 1e-6 * (1 + abs(signal_low))", "numbers", "only that a range of one signal has some width"),
        ("count: int = 1024", "numbers", FINER),
        ("manual_seed(0)", "numbers", RNG),
        ("nan=-1e30", "numbers", "less than any log-likelihood"),
        ("torch.linspace(self.low, self.high, 64", "numbers", FINER),
        (
            "+ jitter.to(coarse)",
            "coarse[row.to(coarse.device)] + jitter.to(coarse)",
            "it is as likely to be of either sign: another draw of the same signals",
        ),
        ("self._observation, self._tolerance, self._size = ", "numbers", "set again before it is used"),
    ],
    "noiseflow/models/digitised.py": [
        ("few: float = 0.02", "numbers", "where a fit begins; it goes on from there"),
        ("max(LEAST_PIXELS, 0.1 * kept.numel())", "numbers", "where a fit begins; it goes on from there"),
        (
            "each.float().mean()) > few",
            "float(each.float().mean()) > few",
            "no share in single precision is 0.02: that number lies between two of them",
        ),
        (
            "self._after(self.model(signal[:0])).represents(observation)",
            "0",
            "the edges are those of the converter, whatever the signals",
        ),
    ],
    "noiseflow/metrics/evaluation.py": [
        ("resamples: int = 64", "numbers", "more resamples: the same expectation with less scatter"),
        ("_SIGNAL_GROUPS = 256", "numbers", SPEED),
        ("shift: float = math.sqrt(5) - 2", "numbers", FINER),
        ("seed: int = 0", "numbers", RNG),
        ("np.random.default_rng(0)", "numbers", RNG),
        (
            "low, high = low - 1.0, low + 2.0",
            "numbers",
            "where the bins of residuals lie that are all equal: any hold them all",
        ),
    ],
    "noiseflow/io/angles.py": [("stacklevel=", "numbers", WARNED)],
    "noiseflow/io/mrc.py": [
        ("stacklevel=", "numbers", WARNED),
        ("data.dtype.itemsize > 2", "2", "integers have 1, 2, 4 or 8 bytes"),
    ],
    "recon/projection/projector.py": [
        ("_PANEL = 32", "numbers", SPEED),
        ("panels = shape[::-1] if whole", "numbers", PANELS),
        ("shape, panel=panels[0]).to", "numbers", PANELS),
        ("shape[::-1], panel=panels[1]).to", "1", PANELS),
        (
            "abs(cosine) >= abs(sine)",
            "abs(cosine) >= abs(sine)",
            "at 45° rounding decides already which of the two sums it is",
        ),
        ("(share > 0)", "share > 0", "entries of weight 0 change no sum"),
    ],
    "recon/projection/base.py": [
        ("_WIDEST = 256", "numbers", SPEED),
        ("widest = _WIDEST if", "dense.device.type == 'cpu'", SPEED),
    ],
    "recon/metrics/metrics.py": [
        ("max(1, mapped.PART // (16", "1", SPEED),
        (
            "product += float(np.sum(centred * (other - means[1])))",
            "other - means[1]",
            "centred sums to nothing, so that any constant may be added to the other: it is taken off for its rounding errors",
        ),
        ("/ power if power > 0 else 0.0", "0.0", "a flat result minus its mean is zero, whatever the gain"),
        (
            "/ (high - low) if high > low else 0.0",
            "0.0",
            "a flat result minus its least value is zero, whatever the gain",
        ),
    ],
    "recon/fields/occupancy.py": [
        ("Occupancy(torch.zeros(1, 1, 1)", "numbers", "an empty volume of any size; its mask is replaced"),
    ],
    "calibration/detector/log_posterior.py": [
        ("np.where(inside[:, None], coordinates, 0.0)", "numbers", "rows outside the priors are not evaluated"),
        ("if moved < 1e-4", "numbers", "changes of a scale so small move nothing"),
        ("if moved < 1e-4", "moved < 0.0001", "changes of a scale so small move nothing"),
        ("default=0.0", "numbers", "of no scales: below the threshold or not, the same posterior is returned"),
        ("little, more = 0.03, 0.2", "numbers", GUESS),
        ("np.diag([little, more *", "more * np.exp(best[0])", GUESS),
        ("np.diag([little, more *", "numbers", GUESS),
        ("SHARE_OF_DEVIATION = 0.5", "numbers", FINER),
        ("np.outer([0.5, 1.0, 2.0], newton)", "numbers", SPEED),
        ("1e-3 * line.gain**2", "numbers", GUESS),
        ("low + 0.1, high - 0.1", "numbers", GUESS),
        ("low + 0.1, high - 0.1", "low + 0.1", GUESS),
        ("low + 0.1, high - 0.1", "high - 0.1", GUESS),
        ("1e-3 * line.gain**2", "line.gain ** 2", GUESS),
        ("1e-3 * line.gain**2", "0.001 * line.gain ** 2", GUESS),
        ("known = [log_posterior.offset[0]]", "0", GUESS),
        ("np.array_split(coordinates, 7)", "numbers", SPEED),
    ],
}
