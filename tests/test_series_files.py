"""Tilt series as microscopes and other programs leave them, each with its right answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

import recon
from noiseflow import io

CASES = Path(__file__).parents[2] / "shared" / "data" / "cases_series"
with_cases = pytest.mark.skipif(not CASES.is_dir(), reason="the small series are not here")


@with_cases
@pytest.mark.parametrize("name", ["hyper.tif", "c2.ome.tif"])
def test_one_of_several_channels_is_chosen_and_never_guessed(name: str, refused, tmp_path: Path) -> None:
    with pytest.raises(io.SeveralImages) as caught:
        recon.read_tilt_series(CASES / name)
    assert caught.value.names == ("0", "1")
    first, second = (recon.read_tilt_series(CASES / name, channel=channel) for channel in (0, "1"))
    assert first.images.shape == second.images.shape == (31, 32, 32)
    assert first.images.std() == pytest.approx(2 * second.images.std(), rel=1e-3)
    mapped = io.read(f"{CASES / name}::1", mapped=True)
    np.testing.assert_array_equal(mapped.data, second.images)
    assert "--channel" in refused("reconstruct", CASES / name, "-o", tmp_path / "v.mrc")
    with pytest.raises(ValueError, match="holds no '2'"):
        io.read(CASES / name, channel=2)


def test_channels_have_the_names_that_ome_gives_them(tmp_path: Path) -> None:
    data = np.random.default_rng(0).integers(0, 99, (2, 5, 6, 7)).astype(np.uint16)
    metadata = {"axes": "CZYX", "Channel": {"Name": ["HAADF", "Fe"]}}
    tifffile.imwrite(tmp_path / "maps.ome.tif", data, metadata=metadata)
    with pytest.raises(io.SeveralImages) as caught:
        io.read(tmp_path / "maps.ome.tif")
    assert caught.value.names == ("HAADF", "Fe")
    np.testing.assert_array_equal(io.read(tmp_path / "maps.ome.tif", channel="Fe").data, data[1])
    tifffile.imwrite(tmp_path / "one.tif", data[0])
    with pytest.raises(ValueError, match="holds one image"):
        io.read(tmp_path / "one.tif", channel="Fe")
