"""Ways of spoiling exposures that were written after the checks and their tolerances, and are only judged, never tuned on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from . import simulators as sim
from .sabotage import Maker, bent
from .simulators import RATIO, Case, both, exposed, pair

Exposures = tuple[sim.Image, sim.Image]


def _shared_charge(generator: np.random.Generator, scene: sim.Image) -> Exposures:
    """A quarter of the charge of each electron goes to the neighbours, before the read noise."""
    kernel = np.array([[0, 1, 0], [1, 12, 1], [0, 1, 0]]) / 16
    charge = [ndimage.convolve(generator.poisson(t * scene).astype(float), kernel) for t in (1, RATIO)]
    return tuple(np.round(100 + 2 * (one + 3 * generator.standard_normal(one.shape))) for one in charge)  # type: ignore[return-value]


def _row_flicker(generator: np.random.Generator, scene: sim.Image) -> Exposures:
    """A rolling shutter under a lamp that flickers by 10 %."""
    rows = 1 + 0.1 * np.sin(2 * np.pi * np.arange(len(scene))[:, None] / 23)
    return exposed(generator, scene * rows), exposed(generator, RATIO * scene)


def _denoised(generator: np.random.Generator, scene: sim.Image) -> Exposures:
    from skimage.restoration import denoise_tv_chambolle

    short, long = sim.clean(generator, scene)
    return np.round(0.5 * short + 0.5 * denoise_tv_chambolle(short, weight=20)), long


def _deinterlaced(image: sim.Image) -> sim.Image:
    found = image.copy()
    found[1:-1:2] = (image[:-2:2] + image[2::2]) / 2
    return found


def _blended(generator: np.random.Generator, scene: sim.Image) -> Exposures:
    """The camera averages each frame with the one before, of the same scene: half of the noise."""
    short = np.mean([exposed(generator, scene) for _ in range(2)], axis=0)
    return np.round(0.7 * short + 0.3 * np.roll(short, 1, axis=1)), exposed(generator, RATIO * scene)


def _burst_that(change: str) -> Maker:
    def make(seed: int) -> Case:
        generator = np.random.default_rng(seed)
        scene = sim.random_scene(generator, 128)
        frames, kept = [], exposed(generator, scene, rounded=False)
        for index in range(8):
            light = scene * (1 - 0.04 * index) if change == "bleaches" else scene.copy()
            if change == "blinks":
                light[generator.random(light.shape) < 0.02] *= 2.0
            frame = exposed(generator, light, rounded=False)
            kept = 0.7 * frame + 0.3 * kept
            frames.append(np.round(kept if change == "is averaged" else frame))
        return Case(np.stack(frames))

    return make


KEPT: dict[str, Maker] = {
    "response light^0.8": bent(0.8),
    "response light^0.9": bent(0.9),
    "response light^1.15": bent(1.15),
    "charge shared with neighbours": lambda s: pair(s, _shared_charge),
    "rows lit by a flickering lamp": lambda s: pair(s, _row_flicker),
    "short half denoised (total variation)": lambda s: pair(s, _denoised),
    "both deinterlaced": lambda s: pair(s, both(_deinterlaced)),
    "averaged and filtered": lambda s: replace(pair(s, _blended), gain=1.0),
    "values × 1.5, rounded again": lambda s: replace(
        pair(s, both(lambda image: np.round(1.5 * np.round(image)))), gain=3.0
    ),
    "offset of 1, clipped at 0": lambda s: pair(
        s, lambda g, x: (exposed(g, x / 20, offset=1.0), exposed(g, RATIO * x / 20, offset=1.0))
    ),
    "right half amplified by 1.2": lambda s: pair(
        s, lambda g, x: sim.clean(g, x, gain=np.where(np.arange(256) < 128, 2.0, 2.4) + np.zeros((256, 1)))
    ),
    "columns of their own gain, 10 %": lambda s: pair(
        s, lambda g, x: sim.clean(g, x, gain=2 * (1 + 0.1 * np.random.default_rng(1).standard_normal((1, 256))))
    ),
    "both filtered by [1 2 1] along y": lambda s: pair(
        s, both(lambda image: np.asarray(ndimage.convolve1d(image, [0.25, 0.5, 0.25], axis=0)))
    ),
    "both sharpened faintly": lambda s: pair(
        s, both(lambda image: np.asarray(1.2 * image - 0.2 * ndimage.gaussian_filter(image, 1.0)))
    ),
    "upper half of the short 5 % darker": lambda s: pair(
        s, lambda g, x: (exposed(g, x * np.where(np.arange(256) < 128, 0.95, 1.0)[:, None]), exposed(g, RATIO * x))
    ),
    "short turned by 0.3° in software": lambda s: pair(
        s, lambda g, x: (np.round(ndimage.rotate(exposed(g, x), 0.3, reshape=False, order=1)), exposed(g, RATIO * x))
    ),
    "ghost of another scene in the long": lambda s: pair(
        s, lambda g, x: (exposed(g, x), exposed(g, RATIO * (x + 0.05 * np.roll(x, (90, 70), axis=(0, 1)))))
    ),
    "burst that bleaches by 4 % a frame": _burst_that("bleaches"),
    "burst that blinks": _burst_that("blinks"),
    "burst of a recursive filter, 0.3": _burst_that("is averaged"),
}
"""Makers by name."""
