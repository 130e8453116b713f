"""How shot noise, read noise and rounding look: samples of three detectors on one clean ramp, and their densities.

python docs/gallery/noise_of_a_camera.py docs/images/noise_of_a_camera.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from noiseflow import Digitised, Gaussian, PoissonGaussian
from noiseflow.io import atomic_path
from noiseflow.report import new_figure, show_image


def draw(path: Path) -> None:
    """Sample and draw."""
    detectors = {
        "Gaussian": Gaussian(1.0),
        "single electrons": PoissonGaussian(gain=1.0, offset=0.0, read_noise=0.2),
        "rounded, clipped at 8": Digitised(
            PoissonGaussian(gain=1.0, offset=0.0, read_noise=0.5), step=1.0, low=0.0, high=8.0
        ),
    }
    ramp = torch.linspace(0.5, 8.0, 128).expand(96, 128)
    readings = torch.linspace(-2, 12, 561)
    figure, axes = new_figure(3, 2, width=12, height=3.2)
    for column, (name, detector) in enumerate(detectors.items()):
        with torch.no_grad():
            show_image(
                axes[0, column], detector(ramp).sample(generator=torch.Generator().manual_seed(0)), name, limits=(-1, 9)
            )
            for signal in (1.0, 4.0):
                distribution = detector(torch.full_like(readings, signal))
                axes[1, column].plot(readings, distribution.cdf(readings), label=f"signal {signal:g}")
        axes[1, column].set_xlabel("reading")
        axes[1, column].set_ylabel("distribution function")
        axes[1, column].legend(fontsize=8)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=80, facecolor="white")


if __name__ == "__main__":
    draw(Path(sys.argv[1] if len(sys.argv) > 1 else "noise_of_a_camera.png"))
