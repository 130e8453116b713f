"""Parameters for other programs: each program's own formula gives back the detector."""

import csv
import json

import pytest

from calibration.camera import Figure
from calibration.report.exports import FILES, simulators, write_exports
from noiseflow.runs.ownership import is_own

DIRECT = [
    Figure("system gain", "K", "counts/e-", 2.0, 1.9, 2.1),
    Figure("temporal dark noise", "σ_d", "e- rms", 3.0),
    Figure("offset", "μ_y.dark", "counts", 100.0),
]


@pytest.mark.parametrize(
    ("figures", "gain"), [(DIRECT, 2.0), ([*DIRECT, Figure("excess-noise factor", "", "", 2.0)], 1.0)]
)
def test_simulators_have_the_gain_and_the_largest_value(figures, gain):
    found = simulators(figures, top=4095, shape=(32, 48))
    getframes, microsim = found["getframes"], found["microsim"]
    assert 1 / getframes["gain_e_per_adu"] == pytest.approx(gain)
    largest = 2 ** microsim["bit_depth"] - 1
    assert microsim["gain"] * largest / microsim["full_well"] == pytest.approx(gain, rel=1e-3)
    assert (largest, getframes["bias_offset_adu"], getframes["resolution"]) == (4095, 100.0, [32, 48])
    assert ("excess_noise_factor" in getframes) == (gain == 1.0)
    assert (
        getframes["read_noise_e"] * gain == microsim["read_noise"] * gain == 6.0
    )  # counts, whatever the multiplication
    assert "prnu" not in getframes  # not measured


def test_a_camera_whose_end_is_unknown_does_not_clip_at_the_brightest_pixel():
    found = simulators(DIRECT, top=float("inf"), shape=(8, 8))
    assert found["microsim"]["bit_depth"] == found["getframes"]["bit_depth"] == 16
    assert found["getframes"]["full_well_e"] == pytest.approx((2**16 - 101) / 2)


def test_files_hold_the_figures_and_are_known_as_own(tmp_path):
    paths = write_exports(tmp_path, DIRECT, top=255, shape=(8, 8), verdict="good")
    assert [path.name for path in paths] == list(FILES[1:])
    assert all(is_own(path) for path in paths)
    rows = list(csv.DictReader(paths[0].read_text(encoding="utf-8").splitlines()[1:]))
    assert [(row["EMVA 1288"], float(row["value"])) for row in rows] == [("K", 2.0), ("σ_d", 3.0), ("μ_y.dark", 100.0)]
    assert json.loads(paths[1].read_text(encoding="utf-8"))["verdict"] == "good"
    assert write_exports(tmp_path / "none", [], top=255, shape=(8, 8), verdict="bad") == []
