"""Synthetic exposures whose scene, transform and detector are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

Image = NDArray[np.float64]
Scene = Callable[[Image, Image], Image]


@dataclass(frozen=True)
class Exposures:
    """A short and a long exposure, and how they were made."""

    short: Image
    long: Image
    signal: Image
    matrix: Image


def textured_scene(generator: np.random.Generator, size: int) -> Scene:
    """A smooth random field with detail from 2 to 20 pixels, between 0 and 1, defined at every real position."""
    pad = size // 3
    field = sum(
        ndimage.gaussian_filter(generator.standard_normal((size + 2 * pad,) * 2), blur) * blur
        for blur in (2.0, 6.0, 20.0)
    )
    field = (field - field.min()) / np.ptp(field)
    coefficients = ndimage.spline_filter(field, 5)
    return lambda x, y: ndimage.map_coordinates(coefficients, [y + pad, x + pad], order=5, prefilter=False)


def sparse_scene(generator: np.random.Generator, size: int) -> Scene:
    """A dozen or more round particles of height 1 on a flat support."""
    centres = generator.uniform(0.05 * size, 0.95 * size, (generator.integers(12, 40), 2))
    radii = generator.uniform(3, 8, len(centres))

    def scene(x: Image, y: Image) -> Image:
        discs = (0.5 - 0.5 * np.tanh(np.hypot(x - cx, y - cy) - r) for (cx, cy), r in zip(centres, radii, strict=True))
        return np.asarray(sum(discs))

    return scene


def rigid(angle: float, shift: tuple[float, float], size: int) -> Image:
    """Matrix that turns by `angle` degrees about the middle of a square frame, then shifts."""
    theta, centre = np.radians(angle), np.full(2, (size - 1) / 2)
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    return np.column_stack([turn, centre - turn @ centre + shift])


def expose(
    scene: Scene,
    matrix: Image,
    size: int,
    generator: np.random.Generator,
    *,
    electrons: float = 60.0,
    gain: float = 2.0,
    read_noise: float = 1.0,
    offset: float = 100.0,
    ratio: float = 16.0,
) -> Exposures:
    """A Poisson-Gaussian pair: the short frame's pixel (x, y) sees what the long one's `matrix` @ (x, y, 1) sees."""
    y, x = np.mgrid[:size, :size].astype(float)
    moved = matrix[:, :2] @ np.stack([x, y]).reshape(2, -1) + matrix[:, 2:]
    dose = electrons * (0.1 + scene(*moved.reshape(2, size, size)).clip(0))
    long_dose = ratio * electrons * (0.1 + scene(x, y).clip(0))

    def reading(rate: Image) -> Image:
        return np.round(offset + gain * (generator.poisson(rate) + read_noise * generator.standard_normal(rate.shape)))

    return Exposures(reading(dose), reading(long_dose), offset + gain * dose, matrix)


@pytest.fixture(scope="session")
def exposures() -> Exposures:
    """A textured pair turned by 1.5 degrees and shifted by (5.3, −3.6) pixels."""
    generator = np.random.default_rng(5)
    return expose(textured_scene(generator, 192), rigid(1.5, (5.3, -3.6), 192), 192, generator)
