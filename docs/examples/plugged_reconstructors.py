"""Reconstructors that `noiseflow.fit` did not know: 2D tomography, deconvolution of a z-stack, super-resolution, and denoising.

    python docs/examples/plugged_reconstructors.py

Each is a module that predicts every measured pixel from an unknown image. The noise model, here with outliers, is learnt
together with the image, and the weight of the penalty is chosen by the likelihood of held-out pixels. Least squares is fitted
in the same way for comparison.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

import noiseflow


class ImagingModel(nn.Module):
    """A non-negative unknown image with total variation; subclasses define how it is measured.

    Args:
        shape: shape of the image, 2D or 3D.
        scale: typical value of the image, its initial value.

    Attributes:
        weight: factor on the total variation; `noiseflow.fit` chooses a further one.
    """

    def __init__(self, shape: Sequence[int], scale: float) -> None:
        super().__init__()
        self.scale, self.weight = scale, 0.2
        self.raw = nn.Parameter(torch.full(tuple(shape), 0.5))

    def image(self) -> Tensor:
        return self.scale * functional.softplus(4 * self.raw) / 2

    def signal(self) -> Tensor:
        raise NotImplementedError

    def forward(self, pixels: Tensor) -> Tensor:
        return self.signal()[pixels]

    def penalty(self) -> Tensor:
        image = self.image() / self.scale
        squares = [image.diff(dim=axis, append=image.narrow(axis, -1, 1)).square() for axis in range(image.ndim)]
        return self.weight * torch.sqrt(sum(squares) + 1e-4).mean()

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": [self.raw], "lr": 0.05}]


class Tomography(ImagingModel):
    """A square image, rotated and summed along its columns: a sinogram (angle, column).

    Args:
        size: pixels along each edge.
        num_angles: number of angles over half a turn.
        scale: typical value of the image.
    """

    def __init__(self, size: int, num_angles: int, scale: float = 1.0) -> None:
        super().__init__((size, size), scale)
        theta = torch.arange(num_angles) * math.pi / num_angles
        turn = torch.stack([theta.cos(), -theta.sin(), 0 * theta, theta.sin(), theta.cos(), 0 * theta], 1)
        grid = functional.affine_grid(turn.view(-1, 2, 3), [num_angles, 1, size, size], align_corners=False)
        self.register_buffer("places", grid)

    def signal(self) -> Tensor:
        rotated = self.image().expand(len(self.places), 1, *self.raw.shape)
        return functional.grid_sample(rotated, self.places, align_corners=False).sum(2).reshape(-1)


class Deconvolution(ImagingModel):
    """A stack (z, y, x), blurred by a Gaussian that is wider along z.

    Args:
        shape: shape of the stack.
        widths: standard deviations of the blur along z, y and x, pixels.
        scale: typical value of the stack.
    """

    def __init__(self, shape: Sequence[int], widths: Sequence[float], scale: float = 1.0) -> None:
        super().__init__(shape, scale)
        transfer = torch.ones(*shape)
        for axis, (size, width) in enumerate(zip(shape, widths, strict=True)):
            along = torch.exp(-2 * (math.pi * width * torch.fft.fftfreq(size)) ** 2)
            transfer = transfer * along.view([-1 if axis == each else 1 for each in range(3)])
        self.register_buffer("transfer", transfer)

    def signal(self) -> Tensor:
        return torch.fft.ifftn(torch.fft.fftn(self.image()) * self.transfer).real.reshape(-1)


class SuperResolution(ImagingModel):
    """Frames (frame, y, x) of one image at unknown shifts; each pixel of a frame is the mean of 2 x 2 pixels of the image.

    Args:
        size: pixels along each edge of a frame.
        num_frames: number of frames; the first one is not shifted.
        scale: typical value of the image.
    """

    def __init__(self, size: int, num_frames: int, scale: float = 1.0) -> None:
        super().__init__((2 * size, 2 * size), scale)
        self.shifts = nn.Parameter(torch.zeros(num_frames - 1, 2))  # pixels of the image, y and x

    def signal(self) -> Tensor:
        shifts = torch.cat([torch.zeros_like(self.shifts[:1]), self.shifts])
        frequency = torch.fft.fftfreq(len(self.raw))
        phase = shifts[:, 0, None, None] * frequency[:, None] + shifts[:, 1, None, None] * frequency
        moved = torch.fft.ifft2(torch.fft.fft2(self.image()) * torch.exp(-2j * math.pi * phase)).real
        return functional.avg_pool2d(moved[:, None], 2).reshape(-1)

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [*super().parameter_groups(), {"params": [self.shifts], "lr": 0.03}]


class Denoising(ImagingModel):
    """One image itself, with as many unknowns as measured pixels."""

    def signal(self) -> Tensor:
        return self.image().reshape(-1)


def discs(*shape: int) -> Tensor:
    """A bright disc (or ball) with a brighter one inside it and a small one beside it."""
    places = torch.meshgrid(*(torch.linspace(-1, 1, size) for size in shape), indexing="ij")

    def disc(centre: Sequence[float], radius: float) -> Tensor:
        return (sum((place - at) ** 2 for place, at in zip(places, centre, strict=False)) < radius**2).float()

    return disc((0.0, -0.15, 0.0), 0.6) + disc((0.1, -0.05, 0.1), 0.25) + disc((0.1, 0.7, 0.5), 0.15)


@torch.no_grad()
def measured(model: ImagingModel, truth: Tensor, noise: float, seed: int = 0) -> Tensor:
    """What the model measures of a true image, with Gaussian noise and outliers in a twentieth of the pixels."""
    start = model.raw.clone()
    model.raw.copy_(torch.log(torch.expm1(2 * truth.clamp(min=1e-3) / model.scale)) / 4)
    clean = model.signal()
    model.raw.copy_(start)
    generator = torch.Generator().manual_seed(seed)
    noisy = clean + noise * torch.randn(clean.shape, generator=generator)
    hit = torch.rand(clean.shape, generator=generator) < 0.05
    return noisy + hit * 40 * noise * torch.rand(clean.shape, generator=generator)


def reconstruct(
    make: Callable[[], ImagingModel], observation: Tensor, noise_model: nn.Module, **options: Any
) -> tuple[Tensor, noiseflow.FitResult]:
    """The image that explains an observation, and the result of the fit."""
    model, generator = make(), torch.Generator().manual_seed(1)
    result = noiseflow.fit(noise_model, model, observation, generator=generator, **options)
    return model.image().detach(), result


def psnr(image: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio, dB."""
    return float(10 * torch.log10(truth.max() ** 2 / (image - truth).square().mean()))


def shifted() -> SuperResolution:
    """Super-resolution with the shifts of the simulated frames."""
    model = SuperResolution(16, 8)
    with torch.no_grad():
        model.shifts.copy_(3 * torch.rand(model.shifts.shape, generator=torch.Generator().manual_seed(2)) - 1.5)
    return model


def learnt() -> nn.Module:
    """A noise model for few pixels: one shape for all signals."""
    return noiseflow.Mixture(4, shared_shape=True, mean_preserving=True)


# name -> the reconstructor, the true instrument, the true image, and the noise of a pixel
SCENES: dict[str, tuple[Callable[[], ImagingModel], Callable[[], ImagingModel], Tensor, float]] = {
    "tomography": (lambda: Tomography(24, 30), lambda: Tomography(24, 30), discs(24, 24), 0.5),
    "deconvolution": (
        lambda: Deconvolution((12, 16, 16), (2.0, 1.0, 1.0)),
        lambda: Deconvolution((12, 16, 16), (2.0, 1.0, 1.0)),
        discs(12, 16, 16),
        0.05,
    ),
    "super-resolution": (lambda: SuperResolution(16, 8), shifted, discs(32, 32), 0.1),
    "denoising": (lambda: Denoising((64, 64), 1.0), lambda: Denoising((64, 64), 1.0), discs(64, 64), 0.3),
}


def main() -> None:
    """Reconstruct each scene with learnt noise and by least squares."""
    for name, (make, instrument, truth, noise) in SCENES.items():
        observation = measured(instrument(), truth, noise)
        for words, noise_model in (("learnt noise", learnt()), ("least squares", noiseflow.Gaussian())):
            image, result = reconstruct(make, observation, noise_model, num_steps=300, weights="held-out")
            factor = result.weight_choice.weight if result.weight_choice else math.nan
            print(f"{name}, {words}: {psnr(image, truth):.1f} dB, factor on the penalty {factor:.2g}")


if __name__ == "__main__":
    main()
