"""Gaussian primitives: against the formula, their gradient."""

import pytest
import torch

import recon
from recon.fields.kinds.gaussians import GaussianField, rotations


@pytest.fixture
def field():
    torch.manual_seed(0)
    field = GaussianField((9, 11, 10), count=12)
    with torch.no_grad():
        field.centre.copy_(torch.rand(12, 3) * torch.tensor([8.0, 10.0, 9.0]))
        field.log_width.copy_(torch.randn(12, 3) * 0.3)
        field.rotation.copy_(torch.randn(12, 4))
        field.peak.copy_(torch.randn(12))
    return field


def sum_at(field, points):
    """The sum without windows, at points (..., 3)."""
    apart = points[..., None, :] - field.centre
    along = torch.einsum("...ni,nij->...nj", apart, rotations(field.rotation)) / field.log_width.exp()
    return (torch.exp(-0.5 * along.square().sum(-1)) * torch.nn.functional.softplus(field.peak)).sum(-1)


def slow(field):
    """The same on the grid (z, y, x)."""
    z, y, x = torch.meshgrid(*(torch.arange(float(size)) for size in (9, 11, 10)), indexing="ij")
    return sum_at(field, torch.stack([z, y, x], -1))


def test_windows_lose_only_the_tails(field):
    expected = slow(field).detach()
    error = field.units().transpose(1, 2).detach() - expected
    assert float(error.abs().max()) < 0.03 * float(expected.max())
    assert float(error.sum().abs()) < 0.03 * float(expected.sum())


def test_values_between_voxels_are_those_of_the_formula(field):
    points = torch.rand(300, 3) * torch.tensor([8.0, 10.0, 9.0])
    expected, found = sum_at(field, points), field.at(points)
    assert float((found - expected).abs().max()) < 0.05 * float(expected.max())
    found.sum().backward()
    assert bool(torch.isfinite(field.centre.grad).all())
    assert field.at(points[:0]).shape == (0,)


def test_gradient_is_that_of_the_windows(field):
    weights = torch.rand(9, 11, 10)
    (field.units().transpose(1, 2) * weights).sum().backward()
    found = {name: parameter.grad.clone() for name, parameter in field.named_parameters()}
    field.zero_grad()
    (slow(field) * weights).sum().backward()
    for name, parameter in field.named_parameters():
        difference = float((found[name] - parameter.grad).norm() / parameter.grad.norm())
        assert difference < 0.15, name  # the tails


def test_a_gaussian_starts_where_the_volume_is(field):
    rough = torch.zeros(3, 3, 3)
    rough[2, 0, 1] = 1.0
    field = GaussianField((9, 9, 9), count=200)
    field.start_from(rough)
    near = ((field.centre.detach() - torch.tensor([7.0, 1.0, 4.0])).abs() < 3.5).all(1)
    assert float(near.float().mean()) > 0.9
    assert float(field.volume().sum()) == pytest.approx(27.0, rel=0.35)


def test_weak_gaussians_move_to_where_the_loss_is_steep():
    field = GaussianField((9, 9, 9), count=3)
    with torch.no_grad():
        field.centre.copy_(torch.tensor([[2.0, 2.0, 2.0], [6.0, 6.0, 6.0], [2.0, 6.0, 2.0]]))
        field.peak.copy_(torch.tensor([1.0, 1.0, -4.0]))
        field.log_width[1].copy_(torch.tensor([0.0, 0.3, 0.0]))
    before, centre, weights = field.volume(), field.centre.detach().clone(), torch.zeros(9, 9, 9)
    weights[5] = 1.0  # steep for the second one, which is wider along y
    for _ in range(15):
        (field.units().transpose(1, 2) * weights).sum().backward()
    assert torch.equal(field.centre, centre)
    field.units()
    after = field.centre.detach()
    torch.testing.assert_close(after[0], centre[0])
    torch.testing.assert_close((after[1] + after[2]) / 2, centre[1])
    torch.testing.assert_close((after[1] - after[2]).abs(), torch.tensor([0.0, 2**0.5 * 1.35, 0.0]), atol=1e-3, rtol=0)
    assert float(field.volume().sum()) == pytest.approx(float(before.sum()), rel=0.03)
    moved = field.centre.detach().clone()
    field.units()
    assert torch.equal(field.centre, moved)


def test_every_parameter_learns_at_its_own_rate():
    field = GaussianField((4, 4, 4), count=3)
    model = recon.TomographySignal(
        field, recon.SliceProjector(tilt_angles=[0.0], depth=4, width=4), recon.Transmission(1.0), learning_rate=0.1
    )
    rates = {id(each): group["lr"] for group in model.parameter_groups(rate=0.5) for each in group["params"]}
    found = {name: rates[id(each)] / 0.05 for name, each in field.named_parameters()}
    assert found == pytest.approx({"centre": 0.3, "peak": 0.6, "log_width": 0.15, "rotation": 0.15})
