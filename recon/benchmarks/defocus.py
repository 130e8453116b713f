"""A benchmark's scene as a converging beam would show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from recon.benchmarks.scenes import Scene
from recon.metrics.comparison import project
from recon.projection.defocused_projector import DefocusedProjector
from recon.projection.projector import SliceProjector
from recon.simulate.simulation import add_noise

STRENGTH = 0.08
"""Pixels of blur per voxel out of the plane of focus: some 2 pixels at the edges of 48 voxels."""


def defocused_scene(scene: Scene, strength: float = STRENGTH) -> Scene:
    """The same volume and noise, with images blurred by depth, see `recon.projection.defocused_projector.DefocusedProjector`."""
    series = scene.clean
    depth, _, width = scene.truth.shape
    projector = SliceProjector(tilt_angles=series.tilt_angles, depth=depth, width=width)
    blurred = DefocusedProjector(projector, strength)(torch.from_numpy(scene.truth)).numpy()
    if series.mode == "transmission":
        sharp = project(scene.truth, series.tilt_angles, mode=series.mode)
        blurred = float(np.median(series.images / sharp)) * np.exp(-blurred)
    clean = replace(series, images=np.ascontiguousarray(blurred, dtype=np.float32))
    name = f"{scene.name}, defocus {strength:g}"
    return replace(scene, clean=clean, noisy=add_noise(clean, scene.noise_model, seed=1), name=name)
