"""Reconstruction of individually denoised images by another method."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from recon.denoise import find_denoiser
from recon.joint.stages import Repeated
from recon.methods._registry import Method, Settings
from recon.reconstruction import Reconstruction
from recon.series.tilt_series import TiltSeries, VolumeGrid


def after_denoising(name: str, description: str, method: Method) -> Method:
    """A method that applies another one to denoised images; the denoiser takes the noise level from a calibrated model."""

    def run(tilt_series: TiltSeries, grid: VolumeGrid, settings: Settings) -> Reconstruction:
        denoiser = settings.denoiser or "nlm"
        denoise = find_denoiser(denoiser, tilt_series.images, noise_model=settings.noise_model)

        def clean_next(images: torch.Tensor, number: int) -> torch.Tensor:
            images[number] = torch.from_numpy(np.asarray(denoise(tilt_series.images[number]), dtype=np.float32))
            return images

        cleaned = Repeated(torch.zeros(tilt_series.images.shape), clean_next, tilt_series.num_tilts)
        settings.run_stage("denoising", cleaned)
        result = method.run(replace(tilt_series, images=cleaned.value.numpy()), grid, settings)
        return replace(result, method=name, choices={"denoiser": denoiser, **result.choices})

    return replace(
        method,
        name=name,
        description=description,
        run=run,
        keeps_noise_model=True,
        refuses=tuple(each for each in method.refuses if each != "denoiser"),
        plan=None,
        blockwise=None,
    )
