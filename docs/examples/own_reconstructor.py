"""A reconstructor of your own, fitted together with the noise: a blind-spot network denoises one real exposure.

    python docs/examples/own_reconstructor.py [--image noisy.tif] [--out denoised.png]

`noiseflow.fit` takes any ``nn.Module`` that maps flat pixel indices to signals: a `SignalModel`. This one is a small
convolutional network that predicts every pixel from its neighbours and never sees the pixel itself, so that it cannot learn to
repeat the noise (Krull et al. 2019, arXiv:1811.10980; by construction as in Laine et al. 2019, arXiv:1901.10277). Network and
noise model learn from the same noisy image, without any clean one; a tenth of the pixels is held out and says when it was best.

By default it denoises the middle of a 50 ms exposure that ships with noiseflow, and compares with the long exposure of the same
cells, which the fit does not see. The noise it learns includes what neighbours cannot tell of a pixel, so it is a little wide.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import noiseflow
from noiseflow.progress import progress_shown
from noiseflow.report import new_figure, show_image

DATA = Path(noiseflow.__file__).parent / "data" / "exposures_miro"


class BlindSpotNetwork(nn.Module):
    """A signal model: each pixel of one noisy image, predicted from the other pixels.

    The first layer sees the eight neighbours of a pixel but not itself; all further ones look only at even distances, from where
    no path leads back to it. The network corrects the mean of the neighbours, where it starts.

    Args:
        image: (y, x) noisy image, detector units.
        channels: width of the network.
        depth: number of dilated layers.
    """

    def __init__(self, image: Tensor, *, channels: int = 24, depth: int = 3) -> None:
        super().__init__()
        self.shape = image.shape
        self.mean, self.scale = float(image.mean()), float(image.std())
        ring = torch.ones(1, 1, 3, 3)
        ring[..., 1, 1] = 0
        self.register_buffer("ring", ring)
        self.register_buffer("image", (image[None, None] - self.mean) / self.scale)
        self.first = nn.Conv2d(1, channels, 3, padding=1, padding_mode="reflect")
        self.further = nn.ModuleList(
            nn.Conv2d(channels, channels, 3, padding=2, dilation=2, padding_mode="reflect") for _ in range(depth)
        )
        self.last = nn.Conv2d(channels, 1, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def signal(self) -> Tensor:
        """All pixels at once, flat, detector units: one pass of the network, which `fit` prefers to asking for single pixels."""
        around = nn.functional.pad(self.image, (1, 1, 1, 1), mode="reflect")
        neighbours = nn.functional.conv2d(around, self.ring / 8)
        hidden = torch.relu(nn.functional.conv2d(around, self.first.weight * self.ring, self.first.bias))
        for layer in self.further:
            hidden = hidden + torch.relu(layer(hidden))
        return (self.mean + self.scale * (neighbours + self.last(hidden))).reshape(-1)

    def forward(self, pixels: Tensor) -> Tensor:
        """Signals of flat pixel indices: all that `fit` needs of a signal model."""
        return self.signal()[pixels]

    def parameter_groups(self) -> list[dict[str, object]]:
        """What `fit` optimises, and how fast it starts."""
        return [{"params": list(self.parameters()), "lr": 3e-3}]


def denoise(noisy: Tensor, *, num_steps: int = 200, seed: int = 0) -> tuple[Tensor, nn.Module, noiseflow.FitResult]:
    """The denoised (y, x) image, its noise model, and how the fit went."""
    torch.manual_seed(seed)
    network = BlindSpotNetwork(noisy)
    # mean preservation keeps an offset of the signal from hiding in the noise
    noise_model = noiseflow.SplineFlow(mean_preserving=True)
    with progress_shown() as progress:
        result = noiseflow.fit(noise_model, network, noisy, num_steps=num_steps, progress=progress)
    with torch.no_grad():
        return network.signal().reshape(noisy.shape), noise_model, result


def psnr(image: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """PSNR in dB of an image whose scale and offset are matched to the reference by least squares."""
    slope, offset = np.polyfit(image.ravel(), reference.ravel(), 1)
    error = np.mean((slope * image + offset - reference) ** 2)
    return float(10 * np.log10((reference.max() - reference.min()) ** 2 / error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", type=Path, default=DATA / "channel1_050ms.tif", help="noisy image")
    parser.add_argument("--reference", type=Path, help="nearly clean image of the same scene, to compare with")
    parser.add_argument("--size", type=int, default=192, help="side of the square in the middle that is denoised")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("own_reconstructor.png"), help="picture to write")
    options = parser.parse_args()
    reference_path = options.reference or (DATA / "channel1_long.tif" if options.image.parent == DATA else None)
    noisy, *reference = (
        middle(noiseflow.io.read_image(path).astype(np.float64), options.size)
        for path in (options.image, reference_path)
        if path is not None
    )
    denoised, noise_model, result = denoise(torch.from_numpy(noisy).float(), num_steps=options.steps)
    print(f"{result.num_steps} steps in {result.seconds:.1f} s, held-out NLL {result.held_out_nll:.4f} nats per pixel")
    levels = torch.quantile(denoised, torch.tensor([0.05, 0.5, 0.95]))
    spread = noise_model(levels).variance.detach().sqrt()
    for level, deviation in zip(levels.tolist(), spread.tolist(), strict=True):
        print(f"noise at signal {level:8.1f}: standard deviation {deviation:.1f}")
    images = {"one noisy image": noisy, "denoised": denoised.double().numpy()}
    titles = [*images]
    if reference:
        titles = [f"{name}: {psnr(image, reference[0]):.1f} dB" for name, image in images.items()]
        print("PSNR " + ", ".join(titles))
    figure, axes = new_figure(2 + len(reference), height=3.6)
    for axis, title, image in zip(axes[0], [*titles, "long exposure"], [*images.values(), *reference], strict=False):
        show_image(axis, image, title)
    figure.savefig(options.out, dpi=110)
    print(f"wrote {options.out}")


def middle(image: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """The square of at most `size` pixels in the middle."""
    top, left = ((length - min(length, size)) // 2 for length in image.shape)
    return image[top : top + size, left : left + size]


if __name__ == "__main__":
    main()
