"""What the occupancy takes for vacuum by default, and what the total variation of a volume is."""

import math

import numpy as np
import pytest
import torch

from recon.fields.occupancy import Occupancy
from recon.fields.regularisers import TotalVariation, total_variation
from recon.projection.projector import SliceProjector


def test_two_voxels_around_the_rough_volume_count_as_occupied():
    rough = torch.zeros(11, 11, 11)
    rough[5, 5, 5] = 1.0
    assert int(Occupancy(rough, (11, 11, 11)).mask.sum()) == 5**3


@pytest.mark.parametrize(("gain", "taken"), [(0.9, False), (1.1, True)])
def test_a_block_is_taken_where_the_data_gain_more_than_its_faces_cost(gain, taken):
    """A cube of b voxels has 6 b² faces; the gain of raising it is the gradient summed over its b³ voxels."""
    block, cost, size = 4, 0.3, 16
    occupancy = Occupancy(torch.zeros(size, size, size), (size, size, size), block=block)
    projector = SliceProjector(tilt_angles=[0.0], depth=size, width=size)
    pull = -gain * 6 * block**2 * cost / block**3
    gradient = torch.zeros(size, size)
    gradient[4:8, 8:12] = pull
    for _ in range(40):
        occupancy.retest(gradient, projector, cost)
    mask = occupancy.mask  # (z, x, y)
    assert bool(mask[:, 4:8, 8:12].all()) is taken
    assert int(mask.sum()) == (size * block * block if taken else 0)


def test_a_margin_wider_than_the_volume_fills_it():
    rough = torch.zeros(2, 3, 9)
    rough[0, 0, 0] = 1.0
    mask = Occupancy(rough, (2, 3, 9), margin=6).mask  # (z, x, y)
    assert mask.shape == (2, 9, 3)
    assert mask.any(1).all()
    assert mask.all(0).all(1).tolist() == [True] * 7 + [False] * 2


def test_blocks_that_gain_nothing_stay_empty_though_they_cost_nothing():
    occupancy = Occupancy(torch.zeros(1, 1, 1), (8, 8, 8))
    projector = SliceProjector(tilt_angles=[0.0], depth=8, width=8)
    for _ in range(40):
        occupancy.retest(torch.zeros(8, 8), projector, 0.0)
    assert not occupancy.mask.any()


@pytest.mark.parametrize("smoothing", [1e-3, 0.5])
def test_total_variation_is_the_sum_of_its_formula(smoothing):
    volume = np.random.default_rng(0).normal(size=(4, 3, 5))
    total = 0.0
    for z in range(4):
        for y in range(3):
            for x in range(5):
                here, squares = volume[z, y, x], smoothing**2
                squares += (volume[z + 1, y, x] - here) ** 2 if z < 3 else 0.0
                squares += (volume[z, y + 1, x] - here) ** 2 if y < 2 else 0.0
                squares += (volume[z, y, x + 1] - here) ** 2 if x < 4 else 0.0
                total += math.sqrt(squares) - smoothing
    assert float(total_variation(volume, smoothing=smoothing)) == pytest.approx(total, rel=1e-12)
    tensor = torch.from_numpy(volume).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: total_variation(v, smoothing=smoothing), tensor)


def test_a_jump_of_a_fiftieth_of_the_scale_counts_less_than_half() -> None:
    """√2 − 1 of what a sharp face would cost: where quadratic turns into linear, unless another place is asked for."""
    step = torch.zeros(2, 1, 1, dtype=torch.float64)
    step[1] = 0.02 * 3.0
    half = math.sqrt(2) - 1
    assert float(TotalVariation()(step, 3.0)) == pytest.approx(half * 0.06, rel=1e-12)
    assert float(TotalVariation(0.5)(25 * step, 3.0)) == pytest.approx(half * 1.5, rel=1e-12)
    for smoothing in (0.0, -0.1, math.nan):
        for refused in (TotalVariation, lambda value: total_variation(step, smoothing=value)):
            with pytest.raises(ValueError, match="must be positive"):
                refused(smoothing)
