"""A small denoiser trained with the likelihood of a noise model in place of squared differences.

    python docs/examples/train_denoiser.py [--steps 300] [--seed 0]

The network sees one noisy exposure and predicts another of the same scene; no clean image takes part (Noise2Noise, Lehtinen et
al. 2018, arXiv:1803.04189). The detector clips: the mean of clipped pixel values is not the signal, so squared differences teach
the network the wrong brightness wherever noise reaches a clipping limit. The likelihood of the clipped values does not. It is
taken from the true noise model, as calibration gives it, and from one that learns together with the network.

Prints the PSNR of scenes that were not trained on, and of their noisy exposures.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from torch import Tensor, nn

import noiseflow
from noiseflow.transforms import AddNoise

SIDE, NUM_TRAINING, NUM_TEST, BATCH = 48, 64, 16, 8
Loss = Callable[[Tensor, Tensor], Tensor]


def scenes(count: int, seed: int) -> Tensor:
    """Smooth random images with sharp-edged discs, (count, 1, y, x), from 0 to 1: both clipping limits matter."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 1, 6, 6, generator=generator)
    smooth = nn.functional.interpolate(coarse, size=SIDE, mode="bicubic", align_corners=False).clamp(0, 1)
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    for _ in range(4):
        cy, cx = SIDE * torch.rand(2, count, 1, 1, 1, generator=generator)
        radius, level = (
            2 + 6 * torch.rand(count, 1, 1, 1, generator=generator),
            torch.rand(count, 1, 1, 1, generator=generator),
        )
        smooth = torch.where((y - cy) ** 2 + (x - cx) ** 2 < radius**2, level, smooth)
    return smooth


def detector() -> nn.Module:
    """Some ten electrons a pixel, read noise, and values clipped to [0, 1]."""
    return noiseflow.Digitised(
        noiseflow.PoissonGaussian(gain=0.1, offset=0.0, read_noise=1.5), step=0.0, low=0.0, high=1.0
    )


class Denoiser(nn.Module):
    """A few convolutions that correct the noisy image."""

    def __init__(self, channels: int = 24) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(1, channels, 5, padding=2), nn.ReLU()]
        for _ in range(2):
            layers += [nn.Conv2d(channels, channels, 3, padding=1), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, 1, 3, padding=1))

    def forward(self, noisy: Tensor) -> Tensor:
        denoised: Tensor = noisy + self.layers(noisy)
        return denoised


def train(loss: Loss, learning: nn.Module | None, num_steps: int, seed: int) -> Denoiser:
    """A denoiser trained on pairs of exposures, and with it whatever else is `learning`."""
    torch.manual_seed(seed)
    network, clean = Denoiser(), scenes(NUM_TRAINING, seed)
    add_noise = AddNoise(detector(), seed=seed)
    groups = [{"params": network.parameters(), "lr": 3e-3}]
    if learning is not None:
        groups.append({"params": learning.parameters(), "lr": 1e-2})
    optimiser = torch.optim.Adam(groups)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, num_steps)
    for _ in range(num_steps):
        batch = clean[torch.randint(NUM_TRAINING, (BATCH,))]
        seen, other = add_noise(batch), add_noise(batch)
        optimiser.zero_grad()
        loss(network(seen), other).backward()
        optimiser.step()
        rates.step()
    return network


def squared(denoised: Tensor, other: Tensor) -> Tensor:
    """The mean squared difference from the other exposure."""
    return (denoised - other).square().mean()


def likelihood(noise_model: nn.Module) -> Loss:
    """The mean negative log-likelihood of the other exposure."""

    def loss(denoised: Tensor, other: Tensor) -> Tensor:
        found: Tensor = -noise_model(denoised).log_prob(other).mean()
        return found

    return loss


def psnr(image: Tensor, clean: Tensor) -> float:
    """PSNR in dB; the range of the scenes is 1."""
    return float(-10 * torch.log10((image - clean).square().mean()))


def compare(num_steps: int, seed: int) -> dict[str, float]:
    """PSNR, dB, of test scenes by each way of training."""
    clean = scenes(NUM_TEST, seed + 1000)
    noisy = AddNoise(detector(), seed=seed + 1000)(clean)
    learnt = noiseflow.Digitised(noiseflow.Mixture(mean_preserving=True), step=0.0, low=0.0, high=1.0)
    learnt.standardise(noisy.reshape(-1), AddNoise(detector(), seed=seed + 2000)(clean).reshape(-1))
    ways: dict[str, tuple[Loss, nn.Module | None]] = {
        "squared differences": (squared, None),
        "likelihood, true noise model": (likelihood(detector().requires_grad_(False)), None),
        "likelihood, noise model learnt along": (likelihood(learnt), learnt),
    }
    found = {"noisy": psnr(noisy, clean)}
    for name, (loss, learning) in ways.items():
        network = train(loss, learning, num_steps, seed)
        with torch.no_grad():
            found[name] = psnr(network(noisy), clean)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for name, figure in compare(options.steps, options.seed).items():
        print(f"{name:40s} {figure:.2f} dB")


if __name__ == "__main__":
    main()
