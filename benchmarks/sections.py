"""Sections and films that go on beside the images: `python -m benchmarks.sections [--size N] [--only WORD] [--spoilt]`.

Prints grade, PSNR and mass of the default volume relative to the truth for each scene and noise; with ``--spoilt``, those of
series whose axis, angles or shifts are wrong. Scenes and projector share no code with the library.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

import recon
from recon.series.tilt_series import TiltSeries
from recon.verdict.judge import judge
from tests.independent_scenes import Array, ball, clean_and_truth, poisson

_REACH = 3.2  # half fields of view: at 60°, an image shows two, and a lamella of 12° more
ANGLES = np.arange(-60, 61, 3.0)


def _particles(
    x: Array, y: Array, z: Array, random: np.random.Generator, count: int, spread: float, radii: Any, value: float
) -> Array:
    found = np.zeros(x.shape, np.float32)
    for _ in range(count):
        centre = random.uniform(-1, 1, 3) * (3, 1, spread)
        found[ball(x, y, z, centre, random.uniform(*radii))] = value
    return found


def section_with_particles(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    return np.asarray(np.maximum((np.abs(z) < 0.3) * 0.3, _particles(x, y, z, random, 60, 0.25, (0.06, 0.15), 1.0)))


def section_of_cells(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    dark, faint = (
        _particles(x, y, z, random, 40, 0.2, radii, value) for radii, value in (((0.1, 0.25), 0.9), ((0.08, 0.2), 0.55))
    )
    return np.asarray(np.where(np.abs(z) < 0.25, np.maximum(0.4, np.maximum(dark, faint)), 0.0))


def particles_on_film(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    found = (np.abs(z) < 0.06) * 0.1
    for _ in range(60):
        radius, side = random.uniform(0.05, 0.14), random.choice([-1, 1])
        centre = random.uniform(-3, 3), random.uniform(-1, 1), side * (0.06 + 0.8 * radius)
        found[ball(x, y, z, centre, radius)] = 1.0
    return found


def lamella_off_by_12_degrees(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    turn = np.deg2rad(12)
    along, through = x * np.cos(turn) + z * np.sin(turn), z * np.cos(turn) - x * np.sin(turn)
    particles = _particles(along, y, through, random, 40, 0.12, (0.06, 0.14), 1.0)
    return np.asarray(np.maximum((np.abs(through) < 0.18) * 0.4, particles))


def film_with_faint_support(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    large = zip(((-0.3, -0.2, -0.1), (0.25, 0.3, -0.15), (0.2, -0.4, -0.2)), (0.25, 0.2, 0.15), strict=True)
    return np.where(np.any([ball(x, y, z, *each) for each in large], axis=0), 1.0, 0.15 * (np.abs(z + 0.4) < 0.05))


def wavy_film(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    through = z - 0.25 * np.sin(2.2 * x) * np.cos(1.3 * y)
    return np.asarray(
        np.maximum((np.abs(through) < 0.12) * 0.3, _particles(x, y, through, random, 50, 0.12, (0.05, 0.12), 1.0))
    )


def film_that_ends_in_the_images(x: Array, y: Array, z: Array, random: np.random.Generator) -> Array:
    inside = (np.abs(z) < 0.15) & (x < 0.1 + 0.3 * np.sin(3 * y))
    return np.where(inside, np.maximum(0.4, _particles(x, y, z, random, 60, 0.13, (0.06, 0.15), 1.0)), 0.0)


def _bright_field(clean: Array, random: np.random.Generator) -> tuple[Array, float]:
    return random.poisson(300 * np.exp(-1.2 * clean)), 1.2


SCENES = (
    section_with_particles,
    section_of_cells,
    particles_on_film,
    lamella_off_by_12_degrees,
    film_with_faint_support,
    wavy_film,
    film_that_ends_in_the_images,
)
NOISES = {
    "40 counts": poisson(40, offset=10, read_noise=2),
    "200 counts": poisson(200, offset=50, read_noise=3),
    "bright field": _bright_field,
}


def _as_given(series: TiltSeries) -> TiltSeries:
    return series


def _shifted(series: TiltSeries) -> TiltSeries:
    shifts = np.random.default_rng(1).integers(-3, 4, series.num_tilts)
    moved = [np.roll(image, by, 1) for image, by in zip(series.images, shifts, strict=True)]
    return replace(series, images=np.stack(moved))


def _turned(series: TiltSeries) -> TiltSeries:
    turned = [ndimage.rotate(image, 5, reshape=False, order=1, mode="nearest") for image in series.images]
    return replace(series, images=np.stack(turned))


SPOILT: dict[str, Callable[[TiltSeries], TiltSeries]] = {
    "axis off by 5°": _turned,
    "angles times 1.3": lambda series: replace(series, tilt_angles=1.3 * series.tilt_angles),
    "shifts of 3 pixels": _shifted,
}


def result(series: TiltSeries, truth: Array) -> str:
    """Grade, PSNR and mass of the default volume of a series, and the reason of the grade."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        prepared = recon.prepare(series)
        found = recon.reconstruct(prepared.tilt_series)
        verdict = judge(prepared.tilt_series, found, screening=prepared.screening, guard=prepared.guard)
    volume = found.volume.attenuation
    psnr = 10 * np.log10(np.ptp(truth) ** 2 / np.mean((volume - truth) ** 2))
    first = "" if verdict.grade == "good" else verdict.reasons[0][:70]
    return f"{verdict.grade:<9} {psnr:6.2f} dB, mass {volume.sum() / truth.sum():.3f}  {first}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=48, help="voxels along each edge")
    parser.add_argument("--only", default="", help="scenes whose name holds this")
    parser.add_argument("--spoilt", action="store_true", help="also series with a wrong axis, angles and shifts")
    arguments = parser.parse_args()
    for scene in SCENES:
        name = scene.__name__.replace("_", " ")
        if arguments.only not in name:
            continue
        clean, truth = clean_and_truth(scene, ANGLES, arguments.size, 0, reach=_REACH)
        for noise, noisy in NOISES.items():
            images, unit = noisy(clean / clean.max(), np.random.default_rng(1))
            mode: Any = "transmission" if noise == "bright field" else "linear"
            series = TiltSeries(images.astype(np.float32), ANGLES, mode=mode)
            for way, spoil in [("", _as_given), *(SPOILT.items() if arguments.spoilt else ())]:
                print(
                    f"{name:<30} {noise:<13} {way:<20} {result(spoil(series), truth * unit / clean.max())}", flush=True
                )


if __name__ == "__main__":
    main()
