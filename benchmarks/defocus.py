"""A benchmark scene imaged with a convergent beam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from benchmarks.scenes import Scene
from recon.metrics.comparison import project
from recon.projection.defocused_projector import with_defocus
from recon.projection.projector import SliceProjector
from recon.simulate.simulation import add_noise

STRENGTH = 0.08
"""Blur in pixels per voxel out of the focal plane: about 2 pixels at the edges of 48 voxels."""


def defocused_scene(scene: Scene, strength: float = STRENGTH, kernel: str = "depth") -> Scene:
    """The same volume and noise with the blur of one of the `recon.projection.defocused_projector.KERNELS`."""
    series = scene.clean
    depth, _, width = scene.truth.shape
    projector = SliceProjector(tilt_angles=series.tilt_angles, depth=depth, width=width)
    blurred = with_defocus(projector, strength, kernel)(torch.from_numpy(scene.truth)).numpy()
    if series.mode == "transmission":
        sharp = project(scene.truth, series.tilt_angles, mode=series.mode)
        blurred = float(np.median(series.images / sharp)) * np.exp(-blurred)
    clean = replace(series, images=np.ascontiguousarray(blurred, dtype=np.float32))
    name = f"{scene.name}, defocus {strength:g}, {kernel}"
    return replace(scene, clean=clean, noisy=add_noise(clean, scene.noise_model, seed=1), name=name)
