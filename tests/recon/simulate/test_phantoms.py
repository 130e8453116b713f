"""Phantoms: drawn in parts as in one piece, and the virion from its atoms."""

import numpy as np
import pytest

from benchmarks.virion_density import density_of_atoms
from recon.simulate.phantoms import PHANTOMS, RADIUS, VOXEL_SIZE, make_phantom, zika_in_box


@pytest.mark.parametrize("name", PHANTOMS)
def test_drawn_by_slices_as_in_one_piece(name):
    whole = make_phantom(name, 30, generator=np.random.default_rng(3))
    parts = [make_phantom(name, 30, generator=np.random.default_rng(3), rows=slice(s, s + 7)) for s in range(0, 30, 7)]
    np.testing.assert_array_equal(np.concatenate(parts, 1), whole)
    assert whole.dtype == np.float32
    assert 0 <= whole.min() < whole.max() <= 1.001


@pytest.mark.parametrize("name", PHANTOMS)
def test_shapes_do_not_depend_on_the_size(name):
    small, large = (make_phantom(name, size, generator=np.random.default_rng(5)) for size in (32, 64))
    binned = large.reshape(32, 2, 32, 2, 32, 2).mean((1, 3, 5))
    assert np.corrcoef(binned.ravel(), small.ravel())[0, 1] > 0.95


def zika(size=61, rotation=None):
    axis = np.linspace(-1, 1, size)
    places = (axis[:, None, None], axis[:, None], axis)
    return zika_in_box(places, 1.0, np.eye(3) if rotation is None else rotation)


def test_virion_is_an_icosahedral_shell():
    density = zika()
    z, y, x = np.indices(density.shape) - 30
    radius = np.sqrt(z**2 + y**2 + x**2) / 30 * RADIUS
    mass = np.histogram(radius, bins=[0, 120, 160, 240, 260], weights=density)[0] / density.sum()
    assert mass[0] < 0.01
    assert mass[2] > 0.9
    turned = np.rot90(density, 2, axes=(0, 2))  # one of its fifteen twofold axes runs along y
    np.testing.assert_allclose(turned, density, atol=0.02)
    assert np.corrcoef(np.rot90(density, 1, axes=(0, 2)).ravel(), density.ravel())[0, 1] < 0.95


def test_virion_keeps_its_hand():
    np.testing.assert_allclose(zika(rotation=-np.eye(3)), zika(), atol=1e-6)


def test_large_virions_show_their_proteins_and_small_ones_a_stand_in():
    fine = make_phantom("virions", 160, generator=np.random.default_rng(0), count=1)
    coarse = make_phantom("virions", 80, generator=np.random.default_rng(0), count=1)
    assert 0 < len(np.unique(coarse[coarse > 0.21])) < len(np.unique(fine[fine > 0.21]))
    assert fine.max() > 0.8


def test_density_of_atoms_weighs_by_atomic_number(tmp_path):
    def atom(x, y, z, element):
        return f"ATOM      1  X   ILE A   1    {x:8.3f}{y:8.3f}{z:8.3f}  1.00155.63          {element:>2}"

    turns = ["1 0 0 0", "0 1 0 0", "0 0 1 0", "-1 0 0 0", "0 -1 0 0", "0 0 1 0"]
    operators = [
        f"REMARK 350   BIOMT{row % 3 + 1}   {row // 3 + 1} {' '.join(turn.split())}" for row, turn in enumerate(turns)
    ]
    path = tmp_path / "two.pdb"
    path.write_text("\n".join([*operators, atom(60, 0, 0, "C"), atom(0, 0, 36, "S")]))
    density = density_of_atoms(path, radius=90, blur=VOXEL_SIZE)
    middle = 15
    assert density.shape == (31, 31, 31)
    assert density[middle, middle, middle + 10] == pytest.approx(density[middle, middle, middle - 10])
    raw = density_of_atoms(path, radius=90, blur=VOXEL_SIZE)
    carbon, sulphur = raw[middle, middle, middle + 10], raw[middle + 6, middle, middle]
    assert sulphur > carbon  # two sulphurs of 16 fall on one place, one carbon of 6 on each of two
    (tmp_path / "none.pdb").write_text("HEADER")
    with pytest.raises(ValueError, match="BIOMT"):
        density_of_atoms(tmp_path / "none.pdb")
