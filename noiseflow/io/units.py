"""Units of length in file formats."""

from __future__ import annotations

_ANGSTROM = {
    **dict.fromkeys(("å", "a", "angstrom", "angstroms", r"\u00c5", "ångström", "ångstrom"), 1.0),
    **dict.fromkeys(("pm", "picometer", "picometre"), 0.01),
    **dict.fromkeys(("nm", "nanometer", "nanometre"), 10.0),
    **dict.fromkeys(("µm", "μm", "um", "micron", "microns", "micrometer", "micrometre", r"\u00b5m", "µ", "μ"), 1e4),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e7),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e8),
    **dict.fromkeys(("inch", "in", '"'), 2.54e8),
    **dict.fromkeys(("m", "meter", "metre"), 1e10),
}


def in_angstrom(unit: object) -> float | None:
    """Å per unit, by its name or symbol; None if it is not a unit of length."""
    return _ANGSTROM.get(str(unit).strip().lower())
