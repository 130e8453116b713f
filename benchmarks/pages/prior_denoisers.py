"""Denoisers of volumes on trial: non-local means, and two small networks that are trained when first asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn

from benchmarks.scenes import Scene
from recon.fields.regularisers import Regulariser
from recon.joint.joint import JointReconstructor
from recon.series.first_guess import attenuation_scale
from recon.series.tilt_series import TiltSeries
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series, tilt_range

Denoiser = Callable[[Tensor], Tensor]  # (z, x, y) in units of the scale, to the same
_SIZE, _PHANTOMS, _TILTS = 48, 10, "-59.5:57.5:1.5"
_PATCH, _BATCH = 24, 2
_STEPS_ON_PHANTOMS, _STEPS_ON_TILTS = 300, 100  # a minute, and a quarter of one, of one processor
_WEIGHT = 0.4  # of total variation in what the networks see: near the best of most scenes


def non_local_means(volume: Tensor) -> Tensor:
    """Non-local means in three dimensions (doi:10.1109/CVPR.2005.38), patches of 3³ within 7³ voxels."""
    from skimage.restoration import denoise_nl_means

    cleaned = denoise_nl_means(volume.numpy(), patch_size=3, patch_distance=3, h=0.05, fast_mode=True)
    return torch.from_numpy(np.asarray(cleaned, dtype=np.float32))


class _Network(nn.Module):
    """Five layers of 3³ kernels, the middle ones spread out to see 19³ voxels; what it gives is added to what it sees."""

    def __init__(self, channels: int = 12) -> None:
        super().__init__()
        widths, spreads = (1, channels, channels, channels, channels, 1), (1, 2, 3, 2, 1)
        layers: list[nn.Module] = []
        for before, after, spread in zip(widths[:-1], widths[1:], spreads, strict=True):
            layers += [nn.Conv3d(before, after, 3, padding=spread, dilation=spread), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])
        nn.init.zeros_(self.layers[-1].weight)

    def forward(self, volumes: Tensor) -> Tensor:
        cleaned: Tensor = volumes + self.layers(volumes)
        return cleaned

    @torch.no_grad()
    def clean(self, volume: Tensor) -> Tensor:
        """A whole volume, never negative."""
        found: Tensor = self(volume[None, None])[0, 0].clamp_min(0)
        return found


def _trained(pairs: list[tuple[Tensor, Tensor]], num_steps: int) -> _Network:
    """Trained on patches of pairs, seen and wanted, mirrored at random along x and y, which tilts treat alike."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = _Network()
        optimiser = torch.optim.Adam(network.parameters(), lr=2e-3)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, num_steps)
        for _ in range(num_steps):
            seen, wanted = zip(
                *(_patch(*pairs[int(torch.randint(len(pairs), ()))]) for _ in range(_BATCH)), strict=True
            )
            loss = (network(torch.stack(seen)[:, None]) - torch.stack(wanted)[:, None]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            decay.step()
    return network


def _patch(seen: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """One with something in it: most of a volume is vacuum."""
    occupied = (wanted > 0.1).nonzero()
    middle = occupied[int(torch.randint(len(occupied), ()))]
    corner = [min(max(0, int(at) - _PATCH // 2), size - _PATCH) for at, size in zip(middle, seen.shape, strict=True)]
    where = tuple(slice(start, start + _PATCH) for start in corner)
    mirrored = [axis for axis in (1, 2) if torch.rand(()) < 0.5]
    return seen[where].flip(mirrored), wanted[where].flip(mirrored)


def _fitted(series: TiltSeries, noise: nn.Module, weight: float, regulariser: Regulariser | None = None) -> Tensor:
    made = JointReconstructor(noise_model=lambda: noise, weight=weight, regulariser=regulariser)
    return _native(made(series).volume.attenuation)


def _native(volume: np.ndarray) -> Tensor:
    """(z, y, x) to (z, x, y), as regularisers see volumes."""
    return torch.from_numpy(np.ascontiguousarray(volume.transpose(0, 2, 1), dtype=np.float32))


@lru_cache(maxsize=1)
def phantom_network() -> Denoiser:
    """From a volume of total variation to the truth, taught on ten random volumes that no benchmark has: polyhedra of random
    planes and blobs of thresholded random fields, some of them shaded, under clipped noise and the tilts of the benchmark."""
    generator, acquisition, pairs = np.random.default_rng(77), ACQUISITIONS["clipped"], []
    assert acquisition.noise is not None
    for number in range(_PHANTOMS):
        density = _random_volume(generator)
        clean, unit = clean_tilt_series(density, tilt_range(_TILTS), acquisition=acquisition)
        noise = acquisition.noise()
        found = _fitted(add_noise(clean, noise, seed=1000 + number), noise, _WEIGHT)
        scale = attenuation_scale(found)
        pairs.append((found / scale, _native(density * np.float32(unit)) / scale))
    return _trained(pairs, _STEPS_ON_PHANTOMS).clean


def _random_volume(generator: np.random.Generator) -> np.ndarray:
    """(z, y, x), zero outside the sphere that touches the faces; half of them have polyhedra, half have blobs."""
    places = np.stack(np.meshgrid(*[(np.arange(_SIZE) + 0.5) * 2 / _SIZE - 1] * 3, indexing="ij"))
    volume = np.zeros((_SIZE,) * 3, np.float32)
    for _ in range(int(generator.integers(3, 25))):
        if generator.uniform() < 0.5:
            share = _polyhedron(places, generator)
        else:
            noise = gaussian_filter(generator.normal(size=volume.shape), generator.uniform(1.5, 4))
            share = np.clip((noise / noise.std() - generator.uniform(1.5, 2.2)) * 3, 0, 1)
        shade = 1 + generator.choice([0, 0.3]) * np.tensordot(generator.normal(size=3), places, 1)
        volume = np.where(share > 0, volume * (1 - share) + share * generator.uniform(0.2, 1) * shade, volume)
    inside = np.clip((1 - np.sqrt((places**2).sum(0))) * _SIZE / 2, 0, 1)
    return np.asarray(np.clip(volume, 0, 1.5) * inside, dtype=np.float32)


def _polyhedron(places: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """The share of each voxel within random planes about a random centre."""
    centre, size = generator.uniform(-0.6, 0.6, 3), generator.uniform(0.06, 0.35)
    normals = generator.normal(size=(int(generator.integers(4, 10)), 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    depth = np.tensordot(normals, places - centre[:, None, None, None], 1).max(0)
    return np.clip(0.5 + (np.minimum(size, 0.4) - depth) * _SIZE / 2, 0, 1) * (np.abs(places).max(0) < 1)


_OF_SCENES: dict[str, Denoiser] = {}  # the four weights of a scene share one training


def tilt_network(scene: Scene) -> Denoiser:
    """The network of `_taught_by_tilts`, taught once for each scene."""
    if scene.name not in _OF_SCENES:
        _OF_SCENES[scene.name] = _taught_by_tilts(scene)
    return _OF_SCENES[scene.name]


def _taught_by_tilts(scene: Scene) -> Denoiser:
    """Noise2Inverse (doi:10.1109/TCI.2020.3019647): from the volume of every second tilt to that of the others, and back, without
    any truth. What it gives for both halves is averaged, whatever volume it is shown."""
    halves = [
        _fitted(
            TiltSeries(scene.noisy.images[part::2], scene.noisy.tilt_angles[part::2], None, scene.noisy.mode),
            scene.noise_model,
            _WEIGHT / 2,
        )
        for part in (0, 1)
    ]
    scale = attenuation_scale(sum(halves) / 2)
    first, second = (half / scale for half in halves)
    network = _trained([(first, second), (second, first)], _STEPS_ON_TILTS)
    cleaned = (network.clean(first) + network.clean(second)) / 2
    return lambda volume: cleaned * (scale / attenuation_scale(cleaned * scale))
