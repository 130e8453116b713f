"""Skipping of vacuum: nothing changes where the field is evaluated, and what the data wants is found."""

import copy
from functools import partial

import numpy as np
import pytest
import torch

from noiseflow import Gaussian
from recon.fields.kinds.grids import MultiresolutionField, VoxelField
from recon.fields.kinds.network import CoordinateNetwork
from recon.fields.occupancy import Occupancy
from recon.joint.joint import JointReconstructor
from recon.joint.signal_model import TomographySignal
from recon.projection.image_formation import Transmission
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import VolumeGrid
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import add_noise, clean_tilt_series


@pytest.fixture
def field():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return CoordinateNetwork((8, 10, 12), scale=0.1, width=16)


def signal_model(field, occupancy, weight=0.3):
    projector = SliceProjector(tilt_angles=[-50.0, 0.0, 40.0], depth=8, width=12)
    return TomographySignal(field, projector, Transmission(), weight=weight, occupancy=occupancy)


@pytest.mark.parametrize("kind", [VoxelField, MultiresolutionField])
def test_fields_skip_alike(kind):
    field = kind((8, 10, 12), scale=0.1)
    field.start_from(torch.rand(8, 10, 12, generator=torch.Generator().manual_seed(0)) * 0.1)
    rough = torch.zeros(8, 10, 12)
    rough[3, 5, 2] = rough[6, 9, 11] = 1.0
    occupancy = Occupancy(rough, (8, 10, 12), margin=1)
    skipping, inside = signal_model(field, occupancy), occupancy.mask.transpose(1, 2)
    torch.testing.assert_close(skipping.volume(), field.volume() * inside)
    (skipping.signal().sum() + skipping.penalty()).backward()
    found = [parameter.grad.clone() for parameter in field.parameters()]
    field.zero_grad()
    columns = field() * occupancy.mask.reshape(-1, 10)
    plain = signal_model(field, None)
    plain._evaluate = lambda: columns
    (plain.signal().sum() + plain.penalty()).backward()
    torch.testing.assert_close(found, [parameter.grad for parameter in field.parameters()])


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_a_margin_reaches_so_many_voxels_in_every_direction(margin):
    rough = torch.zeros(9, 4, 11)
    rough[4, 2, 6] = rough[0, 0, 10] = 1.0
    mask = Occupancy(rough, (9, 4, 11), margin=margin).mask.transpose(1, 2)
    somewhere = torch.stack(torch.meshgrid(*map(torch.arange, (9, 4, 11)), indexing="ij"), -1)
    near = [(somewhere - place).abs().amax(-1) <= margin for place in rough.nonzero()]
    assert torch.equal(mask, torch.stack(near).any(0))


def everything():
    return Occupancy(torch.ones(2, 2, 2), (8, 10, 12))


def test_network_agrees_with_itself_at_single_places(field):
    places = torch.tensor([0, 7, 119, 959])
    torch.testing.assert_close(field.of_voxels(places), field.units().reshape(-1)[places])
    field.start_from(torch.full((8, 10, 12), 0.02))
    assert float(field.volume().mean()) == pytest.approx(0.02, rel=0.5)


def test_skipping_nothing_changes_neither_signal_nor_gradient(field):
    plain, skipping = signal_model(field, None), signal_model(field, everything())
    gradients = []
    for model in (plain, skipping):
        field.zero_grad()
        (model.signal().square().sum() + model.penalty()).backward()
        gradients.append([parameter.grad.clone() for parameter in field.parameters()])
    torch.testing.assert_close(plain.signal(), skipping.signal())
    torch.testing.assert_close(*gradients)


def test_vacuum_is_not_evaluated(field):
    rough = torch.zeros(8, 10, 12)
    rough[3, 5, 2] = 1.0
    occupancy = Occupancy(rough, (8, 10, 12), margin=1)
    volume = signal_model(field, occupancy).volume()
    assert int(occupancy.mask.sum()) == 27
    assert float(volume[2:5, 4:7, 1:4].min()) > 0
    volume[2:5, 4:7, 1:4] = 0
    assert not volume.any()


def test_signal_sees_every_change_of_the_occupied():
    field = VoxelField((8, 10, 12), scale=0.1)
    field.start_from(torch.full((8, 10, 12), 0.1))
    occupancy = Occupancy(torch.zeros(1, 1, 1), (8, 10, 12))
    model, empty = signal_model(field, occupancy), copy.deepcopy(occupancy.state_dict())
    assert not model.volume().any()
    occupancy.mask = torch.ones_like(occupancy.mask)
    torch.testing.assert_close(model.volume(), field.volume())
    occupancy.load_state_dict(empty)
    assert not model.volume().any()
    occupancy.mask |= torch.ones_like(occupancy.mask)
    torch.testing.assert_close(model.volume(), field.volume())


def test_rows_of_an_occupancy():
    rough = torch.rand(8, 10, 12, generator=torch.Generator().manual_seed(0))
    occupancy = Occupancy(rough, (8, 10, 12), least=0.9, margin=0)
    assert torch.equal(occupancy.rows(slice(2, 7)).mask, occupancy.mask[..., 2:7])
    assert 0 < occupancy.share < 1


def test_coarser_occupancy_holds_whatever_the_finer_one_held():
    rough = torch.zeros(8, 10, 12)
    rough[5, 3, 9] = rough[0, 9, 0] = 1.0
    occupancy = Occupancy(rough, (8, 10, 12), margin=0, block=3)
    half = occupancy.coarser((4, 5, 6))
    expected = torch.zeros(4, 5, 6, dtype=torch.bool)
    expected[2, 1, 4] = expected[0, 4, 0] = True
    assert torch.equal(half.mask.transpose(1, 2), expected)
    assert half.block == occupancy.rows(slice(1, 3)).block == 3


def test_rows_of_an_occupancy_can_be_tested_again():
    """Blocks of the part are as large as its own lattice needs, and what is wanted of it stays its own."""
    projector = SliceProjector(tilt_angles=[0.0], depth=8, width=12)
    part = Occupancy(torch.zeros(8, 10, 12), (8, 10, 12), block=3).rows(slice(2, 7))
    assert part.mask.shape == (8, 12, 5)
    assert part.wanted.shape == (3, 4, 2)
    for _ in range(20):
        part.retest(-torch.ones(12, 5), projector, 1e-6)
    assert part.share == 1


@pytest.mark.parametrize("shape", [(2, 9, 12), (2, 1, 12), (3, 3, 3)])
def test_a_volume_thinner_than_a_block_is_tested_again(shape):
    depth, height, width = shape
    projector = SliceProjector(tilt_angles=[0.0], depth=depth, width=width)
    occupancy = Occupancy(torch.zeros(1, 1, 1), shape)
    for _ in range(20):
        occupancy.retest(-torch.ones(width, height), projector, 1e-6)
    assert occupancy.share == 1


def test_what_counts_as_something_is_a_fifth_of_the_scale():
    rough = torch.zeros(6, 6, 6)
    rough[1, 1, 1], rough[4, 4, 4] = 0.19, 0.21
    assert Occupancy(rough, (6, 6, 6), margin=0).mask.nonzero().tolist() == [[4, 4, 4]]


@pytest.mark.parametrize("block", [2, 3, 5])
def test_gain_of_a_block_is_summed_over_its_voxels_and_compared_with_its_faces(block):
    """On a lattice that no block divides, in every place: the last blocks are cut off, and have fewer voxels."""
    shape, cost = (7, 6, 11), 0.01  # (z, y, x)
    projector = SliceProjector(tilt_angles=[-40.0, 10.0, 55.0], depth=7, width=11)
    gradient = torch.randn(33, 6, generator=torch.Generator().manual_seed(0))
    found = Occupancy(torch.zeros(shape), shape, block=block).wants(gradient, projector, cost)
    voxels = projector.backproject(gradient).view(7, 11, 6)  # (z, x, y)
    for place in np.ndindex(*found.shape):
        part = voxels[tuple(slice(k * block, (k + 1) * block) for k in place)]
        assert bool(found[place]) == (float(-part.sum()) > 6 * block**2 * cost)
    assert 0 < int(found.sum()) < found.numel()


def test_vacuum_is_tested_in_every_tenth_step():
    projector, occupancy = (
        SliceProjector(tilt_angles=[0.0], depth=8, width=8),
        Occupancy(torch.zeros(8, 8, 8), (8, 8, 8)),
    )
    shares = []
    for _ in range(30):
        occupancy.retest(-torch.ones(8, 8), projector, 1e-6)
        shares.append(occupancy.share)
    assert shares == [0.0] * 19 + [1.0] * 11  # wanted in the tenth, and again in the twentieth


def test_what_the_data_wants_becomes_occupied_and_nothing_else():
    """Images of a ball that the rough volume does not show: the likelihood's gradient finds it."""
    truth = torch.zeros(16, 16, 16)
    truth[6:10, 5:11, 7:12] = 0.1
    projector = SliceProjector(tilt_angles=[-60.0, -30.0, 0.0, 30.0, 60.0], depth=16, width=16)
    observed = torch.exp(-projector(truth)).transpose(1, 2).reshape(-1)
    field = CoordinateNetwork((16, 16, 16), scale=0.1, width=8, layers=2)
    occupancy = Occupancy(torch.zeros(2, 2, 2), (16, 16, 16))
    occupancy.mask[0, 0, 0] = True
    model = TomographySignal(field, projector, Transmission(), weight=0.2, occupancy=occupancy)
    for _ in range(20):
        loss = 50 * (model.signal() - observed).square().mean() + model.penalty()
        loss.backward()
    found = occupancy.mask.transpose(1, 2)
    assert bool(found[truth > 0].all())
    assert not found[:, 12:].any()
    assert occupancy.share < 0.6


def test_what_is_wanted_only_once_stays_empty():
    projector, occupancy = (
        SliceProjector(tilt_angles=[0.0], depth=8, width=8),
        Occupancy(torch.zeros(2, 2, 2), (8, 8, 8)),
    )
    swings = -torch.ones(8, 8), torch.ones(8, 8)
    for step in range(40):
        occupancy.retest(swings[step // 10 % 2], projector, 1e-6)
    assert occupancy.share == 0
    for _ in range(20):
        occupancy.retest(swings[0], projector, 1e-6)
    assert occupancy.share == 1


def test_reconstructor_skips_unless_told_not_to_and_starts_from_its_seed():
    density = make_phantom("shells", 16, generator=np.random.default_rng(1), count=2)
    clean, _ = clean_tilt_series(density, np.arange(-60, 61, 20.0))
    noisy = add_noise(clean, Gaussian(0.5 * float(clean.images.std())), seed=0)
    make = partial(CoordinateNetwork, width=8, layers=2)
    grid = VolumeGrid.of(noisy)
    first, second, plain = (
        JointReconstructor(make_field=make, skip_vacuum=skip).signal_model(noisy, grid) for skip in (True, True, False)
    )
    assert plain.occupancy is None
    dense, _ = clean_tilt_series(np.ones((8, 16, 16), np.float32), np.arange(-60, 61, 20.0))
    assert JointReconstructor().signal_model(dense, VolumeGrid.of(dense, 8)).occupancy is None
    assert torch.equal(first.occupancy.mask, second.occupancy.mask)
    torch.testing.assert_close(first.field.volume(), second.field.volume(), rtol=0, atol=0)
