"""A small program as a user writes it; `mypy --strict` must find nothing in it."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import calibration
import noiseflow
from recon import JointReconstructor, SliceProjector, TiltSeries, VolumeGrid, read_tilt_series, sirt


def detector_model(short: Path, long: Path, target: Path) -> str:
    """Calibrate and save."""
    (pair,) = calibration.read_pairs([short], [long])
    pixels = calibration.collect_pixels([calibration.align_pair(pair)])
    best = calibration.simplest_sufficient(calibration.fit_models(pixels))
    noiseflow.save(best.model, target, units="counts")
    return best.name


def noisy_copy(model_file: Path, clean: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sample noise, and judge the model on it."""
    model = noiseflow.load(model_file)
    signal = torch.from_numpy(clean)
    observation = model(signal).sample(generator=torch.Generator().manual_seed(0))
    result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, num_steps=10)
    quality: float = result.held_out_nll
    evaluation = noiseflow.metrics.evaluate(model, signal.reshape(-1), observation.reshape(-1))
    print(quality, evaluation.nll)
    noisy: NDArray[np.float32] = observation.numpy()
    return noisy


def reconstruct(stack: Path, target: Path) -> TiltSeries:
    """Reconstruct a volume in two ways."""
    series = read_tilt_series(stack, mode="linear")
    grid = VolumeGrid.of(series, thickness=32)
    result = JointReconstructor(num_steps=10)(series, grid)
    result.volume.write(target)
    projector = SliceProjector(tilt_angles=series.tilt_angles, depth=grid.depth, width=grid.width)
    classical: torch.Tensor = sirt(torch.from_numpy(series.images.astype(np.float32)), projector, num_iterations=5)
    image_file = noiseflow.io.read(target)
    print(image_file.voxel_size, image_file.data.shape, classical.shape)
    return series
