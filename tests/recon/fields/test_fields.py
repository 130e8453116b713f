"""Fields, total variation and image formation."""

import pytest
import torch
from torch.nn import functional

from recon.fields.kinds.grids import MultiresolutionField, VoxelField, upsample
from recon.fields.regularisers import total_variation
from recon.projection.image_formation import Linear, Transmission


@pytest.mark.parametrize("make", [VoxelField, MultiresolutionField])
@pytest.mark.parametrize("shape", [(8, 8, 8), (5, 12, 9), (1, 3, 2)])
def test_field_is_positive_and_starts_constant(make, shape):
    field = make(shape, scale=2.0)
    depth, height, width = shape
    assert field().shape == (depth * width, height)
    torch.testing.assert_close(field().detach(), torch.full((depth * width, height), 0.006))
    assert field.volume().shape == shape


@pytest.mark.parametrize("make", [VoxelField, MultiresolutionField])
def test_field_starts_from_a_rough_volume(make):
    field = make((16, 24, 20), scale=0.1)
    rough = torch.zeros(16, 6, 20)
    rough[8:, :3, 10:] = 0.2
    field.start_from(rough)
    start = field.volume()
    assert float(start[12:, :8, 15:].mean()) == pytest.approx(0.2, rel=0.05)
    assert 0 < float(start[:4, 16:, :5].mean()) < 0.001


def test_every_grid_of_a_field_learns():
    field = MultiresolutionField((9, 12, 17))
    (field() ** 2).sum().backward()
    assert all(float(grid.grad.abs().min()) > 0 for grid in field.grids)


@pytest.mark.parametrize("shape", [(6, 8, 10), (5, 7, 9), (1, 2, 3), (12, 1, 2)])
def test_upsampling_equals_the_general_interpolation(shape):
    coarse = [(size + 1) // 2 for size in shape]
    grid = torch.rand(coarse, dtype=torch.float64, requires_grad=True)
    even = [2 * size for size in coarse]
    expected = functional.interpolate(grid[None, None], size=even, mode="trilinear")[0, 0]
    torch.testing.assert_close(upsample(grid, shape), expected[: shape[0], : shape[1], : shape[2]])
    assert torch.autograd.gradcheck(lambda values: upsample(values, shape), grid)
    fine = torch.rand(shape, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(upsample(grid, shape, plus=fine), upsample(grid, shape) + fine)
    assert torch.autograd.gradcheck(lambda values, more: upsample(values, shape, plus=more), (grid, fine))


def slow_total_variation(volume, smoothing):
    padded = functional.pad(volume[None, None], (0, 1, 0, 1, 0, 1), mode="replicate")[0, 0]
    squares = sum(
        torch.diff(padded, dim=axis)[
            : -1 if axis != 0 else None, : -1 if axis != 1 else None, : -1 if axis != 2 else None
        ]
        ** 2
        for axis in range(3)
    )
    return (torch.sqrt(squares + smoothing**2) - smoothing).sum()


def test_total_variation_and_its_gradient():
    volume = torch.rand(4, 5, 6, dtype=torch.float64, requires_grad=True)
    value, expected = total_variation(volume, smoothing=0.1), slow_total_variation(volume, 0.1)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(torch.autograd.grad(value, volume), torch.autograd.grad(expected, volume))


def test_total_variation_of_a_flat_volume_is_zero_and_scales_with_the_volume():
    flat = torch.full((3, 4, 5), 0.7, dtype=torch.float64, requires_grad=True)
    value = total_variation(flat, smoothing=0.01)
    value.backward()
    assert value == 0
    assert not flat.grad.any()
    volume = torch.rand(3, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(total_variation(7 * volume, smoothing=0.7), 7 * total_variation(volume, smoothing=0.1))


def test_total_variation_of_a_step_is_its_area():
    volume = torch.zeros(6, 5, 4, dtype=torch.float64)
    volume[3:] = 2.0
    assert float(total_variation(volume, smoothing=1e-6)) == pytest.approx(2.0 * 5 * 4, rel=1e-5)


@pytest.mark.parametrize("response", [Transmission(3.0, offset=0.5), Linear(2.0, offset=0.3)])
def test_response_is_inverted(response):
    line_integrals = torch.rand(2, 3, 4)
    with torch.no_grad():
        torch.testing.assert_close(response.invert(response(line_integrals)), line_integrals)


def test_responses():
    line_integrals = torch.tensor([[[0.0, 1.0]]])
    torch.testing.assert_close(
        Transmission(2.0, offset=1.0)(line_integrals).detach(), 1 + 2 * torch.exp(-line_integrals)
    )
    torch.testing.assert_close(Linear(3.0, offset=1.0)(line_integrals).detach(), 1 + 3 * line_integrals)
    per_tilt = Transmission(torch.tensor([1.0, 2.0]))(torch.zeros(2, 1, 1)).detach().flatten()
    torch.testing.assert_close(per_tilt, torch.tensor([1.0, 2.0]))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: VoxelField((0, 4, 4)), "shape"),
        (lambda: VoxelField((4, 4)), "shape"),
        (lambda: total_variation(torch.zeros(2, 2, 2), smoothing=0.0), "smoothing"),
        (lambda: Transmission(-1.0), "positive"),
        (lambda: Linear(0.0), "gain"),
    ],
)
def test_impossible_values_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
