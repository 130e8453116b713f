"""Small frames, lattices and repeated textures register; their like of another scene are refused."""

import numpy as np
import pytest
from scipy import ndimage

from calibration.exposures.frames import ExposurePair
from calibration.pipeline import measure_exposures
from calibration.registration.align import register

from ..simulators import RATIO, exposed, random_scene

MODULATIONS = {
    "perfect": lambda x, y: 1.0,
    "gradient": lambda x, y: 1 + 0.005 * (x - 64),
    "slow waves": lambda x, y: 1 + 0.2 * np.sin(x / 16) + 0.2 * np.sin(y / 16),
}


def lattice(x, y, period, *, angle=0.0, modulation="perfect"):
    """Electrons of two plane waves at 60°."""
    waves = (
        0.5 * np.cos(2 * np.pi / period * (np.cos(turn) * x + np.sin(turn) * y)) for turn in (angle, angle + np.pi / 3)
    )
    return 80 * (1.2 + sum(waves)) / 1.2 * MODULATIONS[modulation](x, y)


def from_lattice(shift, period, angle):
    """A shift less its nearest lattice vector."""
    waves = 2 * np.pi / period * np.array([[np.cos(t), np.sin(t)] for t in (angle, angle + np.pi / 3)])
    phases = waves @ shift / (2 * np.pi)
    return 2 * np.pi * np.linalg.solve(waves, phases - np.round(phases))


def pair_of(generator, short, long):
    return exposed(generator, short), exposed(generator, RATIO * long)


def small_pair(seed, size):
    """A pair of one scene, the long exposure displaced, and that displacement (x, y)."""
    generator = np.random.default_rng(seed)
    shift = generator.uniform(-4, 4, 2)
    scene = random_scene(generator, size + 16)
    moved = ndimage.shift(scene, shift[::-1], order=5, mode="mirror")
    return pair_of(generator, *(image[8:-8, 8:-8] for image in (scene, moved))), shift


@pytest.mark.parametrize("size", [40, 64])
def test_small_frames_register(size):
    errors = []
    for seed in range(10):
        (short, long), shift = small_pair(seed, size)
        found = register(short, long)
        errors.append(np.linalg.norm(found.matrix[:, 2] - shift))
        assert errors[-1] < 4 * found.error_px
    assert np.median(errors) < 0.08


def test_a_small_pair_is_calibrated():
    (short, long), _ = small_pair(0, 64)
    gain = measure_exposures([ExposurePair(short, long)]).figures.gain
    assert gain.q05 < 2 < gain.q95


@pytest.mark.parametrize("modulation", MODULATIONS)
@pytest.mark.parametrize("seed", range(4))
def test_a_lattice_registers_up_to_its_own_vectors(seed, modulation):
    generator = np.random.default_rng(seed)
    (y, x), period, angle = np.indices((128, 128)), generator.uniform(5, 20), generator.uniform(0, np.pi)
    shift = generator.uniform(-7, 7, 2)
    clean = (lattice(x + dx, y + dy, period, angle=angle, modulation=modulation) for dx, dy in (shift, (0, 0)))
    found = register(*pair_of(generator, *clean))
    left = found.matrix[:, 2] - shift
    assert found.motion == "translation"
    assert not found.inverted
    assert np.linalg.norm(left if modulation == "slow waves" else from_lattice(left, period, angle)) < 0.05


def test_a_repeated_texture_registers_at_its_smallest_shift():
    generator = np.random.default_rng(0)
    scene = np.tile(
        80 * np.exp(2 * ndimage.gaussian_filter(generator.standard_normal((32, 32)), 1.5, mode="wrap")), (6, 6)
    )
    short, long = pair_of(generator, scene, scene)
    assert register(short, np.roll(long, 7, axis=1)).matrix[:, 2] == pytest.approx((7, 0), abs=0.05)


def other_scenes(seed):
    """Pairs that no registration may accept, with the size of the frames."""
    generator = np.random.default_rng(seed)
    size = int(generator.choice([40, 64, 128]))
    y, x = np.indices((size, size))
    period, angle = generator.uniform(5, 18), generator.uniform(0, np.pi)
    light = 1 - 0.5 * ((x - size / 2) ** 2 + (y - 0.4 * size) ** 2) / size**2
    scenes = {
        "two scenes": [random_scene(generator, size) for _ in range(2)],
        "two scenes, one light": [random_scene(generator, size, contrast=0.1) * light for _ in range(2)],
        "flat": [np.full((size, size), 80.0)] * 2,
        "shaded": [300 * light] * 2,
        "two lattices": [
            lattice(x, y, generator.uniform(5, 20), angle=turn) for turn in generator.uniform(0, np.pi, 2)
        ],
        "another period": [
            lattice(x, y, each * period, angle=angle) for each in (1, generator.choice([0.9, 1.07, 1.2]))
        ],
    }
    return {name: pair_of(generator, *clean) for name, clean in scenes.items()}


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 40))])
def test_other_scenes_are_refused(seed):
    for short, long in other_scenes(seed).values():
        with pytest.raises(ValueError, match="cannot be registered"):
            register(short, long)
