"""What must not change a volume: order, doubled tilts, constants, scales, full turns, mirrors and transposed files."""

from __future__ import annotations

import itertools
import tracemalloc
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from noiseflow import Gaussian, NoiseModelBase, ScanNoise, SplineFlow, WithMaps
from recon.methods import reconstruct
from recon.methods._registry import Settings, find_method
from recon.projection.classical import angular_shares
from recon.reconstruction import Reconstruction
from recon.series.holdout import Holdout
from recon.series.orientation import Orientation
from recon.series.prepare import prepare
from recon.series.tilt_series import TiltSeries, VolumeGrid
from recon.series.views import in_order, level_of, view_numbers, without_level
from recon.simulate.phantoms import make_phantom
from recon.simulate.simulation import ACQUISITIONS, add_noise, clean_tilt_series
from recon.uncertainty import error_bars

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # angles that occur twice are meant

ANGLES = np.arange(-60, 61, 3.0)
Array = np.ndarray


@pytest.fixture(scope="module")
def series() -> TiltSeries:
    density = make_phantom("particles", 32, generator=np.random.default_rng(0))
    acquisition = ACQUISITIONS["low-dose"]
    clean, _ = clean_tilt_series(density, ANGLES, acquisition=acquisition)
    return add_noise(clean, acquisition.noise(), seed=1)


def volume(series: TiltSeries, method: str, **options: float) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        prepared = prepare(series, **options).tilt_series
    return reconstruct(prepared, VolumeGrid.of(prepared), method=method).volume.attenuation


def shuffled(series: TiltSeries) -> TiltSeries:
    return series.select(np.random.default_rng(3).permutation(series.num_tilts))


def doubled(series: TiltSeries) -> TiltSeries:
    return series.select(np.arange(2 * series.num_tilts) % series.num_tilts)


def full_turns(series: TiltSeries) -> TiltSeries:
    return replace(series, tilt_angles=series.tilt_angles + 360)


def mirrored(series: TiltSeries) -> TiltSeries:
    return replace(series, images=series.images[:, :, ::-1], tilt_angles=-series.tilt_angles)


def upside_down(series: TiltSeries) -> TiltSeries:
    return replace(series, images=series.images[:, ::-1])


def raised(series: TiltSeries) -> TiltSeries:
    return replace(series, images=series.images.astype(np.float64) + 1e5)


def scaled(series: TiltSeries) -> TiltSeries:
    return replace(series, images=series.images.astype(np.float64) * 1e-4)


CHANGES: dict[str, tuple[Callable[[TiltSeries], TiltSeries], Callable[[Array], Array], float]] = {
    "any order": (shuffled, lambda found: found, 1e-5),
    "doubled tilts": (doubled, lambda found: found, 0.01),
    "full turns": (full_turns, lambda found: found, 1e-4),
    "mirrored": (mirrored, lambda found: found[:, :, ::-1], 1e-4),
    "upside down": (upside_down, lambda found: found[:, ::-1], 1e-4),
    "constant added": (raised, lambda found: found, 1e-4),
    "scaled": (scaled, lambda found: found * 1e4, 1e-4),
}


@pytest.fixture(scope="module")
def wanted(series: TiltSeries) -> dict[str, Array]:
    """The volume of each method."""
    return {method: volume(series, method) for method in ("wbp", "sirt")}


@pytest.mark.parametrize("method", ["wbp", "sirt"])
@pytest.mark.parametrize("change", CHANGES)
def test_the_same_series_in_other_words_gives_the_same_volume(
    series: TiltSeries, wanted: dict[str, Array], method: str, change: str
) -> None:
    how, back, tolerance = CHANGES[change]
    assert rms_between(back(volume(how(series), method)), wanted[method]) < tolerance


@pytest.mark.parametrize("method", ["wbp", "sirt"])
def test_a_transposed_file_with_the_axis_turned_gives_the_mirrored_volume(
    series: TiltSeries, wanted: dict[str, Array], method: str
) -> None:
    transposed = replace(series, images=np.ascontiguousarray(series.images.transpose(0, 2, 1)))
    wanted, found = wanted[method], volume(transposed, method, tilt_axis=90.0)
    np.testing.assert_allclose(found[:, ::-1], wanted, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize("method", ["wbp", "sirt"])
def test_methods_alone_do_not_depend_on_order_or_twins(series: TiltSeries, method: str) -> None:
    wanted = reconstruct(series, VolumeGrid.of(series), method=method).volume.attenuation
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for changed, tolerance in ((shuffled(series), 1e-5), (doubled(series), 0.01)):
            found = reconstruct(changed, VolumeGrid.of(series), method=method).volume.attenuation
            assert np.sqrt(np.mean((found - wanted) ** 2)) < tolerance * np.sqrt(np.mean(wanted**2))


@pytest.fixture(scope="module")
def small() -> TiltSeries:
    density = make_phantom("particles", 16, generator=np.random.default_rng(0))
    clean, _ = clean_tilt_series(density, ANGLES, acquisition=ACQUISITIONS["low-dose"])
    return add_noise(clean, ACQUISITIONS["low-dose"].noise(), seed=1)


def fitted(series: TiltSeries, method: str) -> Reconstruction:
    """Few steps: what is the same step by step stays so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return reconstruct(series, VolumeGrid.of(series), method=method, weight=1.0, num_steps=12)


FITTED = ("any order", "doubled tilts", "full turns", "mirrored", "upside down", "constant added")
FITTED_METHODS = [pytest.param("l2"), pytest.param("l1", marks=pytest.mark.slow)]
JOINT = pytest.param("joint", marks=pytest.mark.slow)


def negated(series: TiltSeries) -> TiltSeries:
    return replace(series, tilt_angles=-series.tilt_angles)


def rms_between(found: Array, wanted: Array) -> float:
    return float(np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)))


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("method", [*FITTED_METHODS, JOINT])
def test_a_fit_of_the_same_series_in_other_words_gives_the_same_volume(small: TiltSeries, method: str) -> None:
    wanted = fitted(small, method).volume.attenuation
    for change in FITTED:
        how, back, _ = CHANGES[change]
        assert rms_between(back(fitted(how(small), method).volume.attenuation), wanted) < 1e-4, change


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_what_a_joint_fit_chooses_does_not_depend_on_a_constant_added(small: TiltSeries) -> None:
    wanted, found = (volume(series, "joint") for series in (small, raised(small)))
    assert rms_between(found, wanted) < 1e-4


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("method", [*FITTED_METHODS, JOINT])
def test_a_fit_of_a_transposed_file_gives_the_flipped_volume(small: TiltSeries, method: str) -> None:
    transposed = replace(small, images=np.ascontiguousarray(small.images.transpose(0, 2, 1)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wanted = fitted(prepare(small).tilt_series, method).volume.attenuation
        for axis, back in ((90.0, np.s_[:, ::-1]), (-90.0, np.s_[::-1, :, ::-1])):
            found = fitted(prepare(transposed, tilt_axis=axis).tilt_series, method).volume.attenuation[back]
            assert rms_between(found, wanted) < 1e-4


@pytest.mark.usefixtures("one_thread")
def test_all_that_a_fit_gives_is_of_the_series_as_it_was_given(small: TiltSeries) -> None:
    series = replace(
        small,
        beam=np.linspace(0.8, 1.2, small.num_tilts),
        mode="transmission",
        images=small.images.max() - small.images + 9,
    )
    options = {"method": "l2", "weight": 1.0, "num_steps": 12, "uncertainty": 2}
    found = reconstruct(series, **options)
    flips = {
        "mirrored": (mirrored(series), np.s_[:, :, ::-1], np.s_[:, :, ::-1]),
        "negated": (negated(series), np.s_[::-1], np.s_[:]),
        "upside down": (upside_down(series), np.s_[:, ::-1], np.s_[:, ::-1]),
    }
    for name, (changed, of_volume, of_images) in flips.items():
        other = reconstruct(changed, **options)
        np.testing.assert_array_equal(other.projections[of_images], found.projections, err_msg=name)
        np.testing.assert_array_equal(other.uncertainty.std.attenuation[of_volume], found.uncertainty.std.attenuation)
        np.testing.assert_array_equal(other.uncertainty.bias.attenuation[of_volume], found.uncertainty.bias.attenuation)
        np.testing.assert_array_equal(other.response["intensity"], found.response["intensity"])


@pytest.mark.usefixtures("one_thread")
def test_response_and_error_bars_are_of_the_tilts_as_they_were_given(small: TiltSeries) -> None:
    series = replace(small, beam=np.linspace(0.8, 1.2, small.num_tilts), mode="transmission")
    options: dict[str, Any] = {"method": "l2", "weight": 1.0, "num_steps": 12}
    given = np.random.default_rng(0).permutation([*range(series.num_tilts), 2, 5, 5])  # three copies
    for changed in (series, negated(series)):
        found, other = reconstruct(changed, **options), reconstruct(changed.select(given), **options)
        np.testing.assert_array_equal(other.projections, found.projections[given])
        assert other.response == {name: [values[at] for at in given] for name, values in found.response.items()}
        assert error_bars(other, changed.select(given), 2).std.attenuation.max() > 0
        once = changed.select(np.random.default_rng(1).permutation(series.num_tilts))
        first, second = (error_bars(reconstruct(each, **options), each, 2) for each in (changed, once))
        np.testing.assert_array_equal(first.std.attenuation, second.std.attenuation)


def through_the_library(series: TiltSeries, options: dict[str, Any]) -> Reconstruction:
    return reconstruct(series, method="joint-supervised", **options)


def without_flips(series: TiltSeries, options: dict[str, Any]) -> Reconstruction:
    return find_method("joint-supervised").run(series, VolumeGrid.of(series), Settings(**options))


@pytest.mark.parametrize(
    "model", [WithMaps(Gaussian(1.0), shape=(9, 9)), ScanNoise(Gaussian(1.0)), SplineFlow(neighbourhood=3)]
)
def test_noise_models_of_images_are_refused(small: TiltSeries, model: NoiseModelBase) -> None:
    with pytest.raises(ValueError, match="single pixels"):
        reconstruct(small, noise_model=model)


@pytest.mark.slow
def test_a_far_level_comes_back_in_projections_offset_and_noise_model(small: TiltSeries) -> None:
    options = {"method": "joint", "weight": 1.0, "num_steps": 12}
    low, high = reconstruct(small, **options), reconstruct(raised(small), **options)
    np.testing.assert_allclose(high.projections - 1e5, low.projections, atol=0.02)
    np.testing.assert_allclose(high.response["offset"], np.array(low.response["offset"]) + 1e5, atol=0.02)
    signals = np.linspace(1.0, 5.0, 5)
    near, far = low.noise_model(signals), high.noise_model(signals + 1e5)
    np.testing.assert_allclose(far.variance, near.variance, rtol=0.02)
    np.testing.assert_allclose(far.mean - 1e5, near.mean, atol=0.02)


def test_twins_and_opposite_views_share_a_number() -> None:
    numbers = view_numbers(np.array([0.0, 10, 10.001, 20, 190, -20, 380, -10]))
    assert numbers.tolist() == [2, 3, 3, 4, 3, 0, 4, 1]
    whole = view_numbers(np.arange(-90, 91, 2.0))
    assert whole[0] == whole[-1]
    assert whole.max() == 89


def _held_out(angles: Array, every: int) -> Array:
    return Holdout.views(angles, every).groups == 1


@pytest.mark.parametrize("angles", [ANGLES, np.arange(-90, 90, 2.0), np.arange(0, 178, 3.0), ANGLES[:-1]])
def test_views_left_out_do_not_depend_on_order_twins_or_sign(angles: Array) -> None:
    out = _held_out(angles, 5)
    assert 0.15 < out.mean() < 0.25
    order = np.random.default_rng(0).permutation(len(angles))
    np.testing.assert_array_equal(_held_out(angles[order], 5), out[order])
    np.testing.assert_array_equal(_held_out(np.r_[angles, angles + 360], 5), np.r_[out, out])
    if not np.ptp(angles) > 170:  # a full circle has no end to count from that a mirror keeps
        np.testing.assert_array_equal(_held_out(-angles, 5), out)


def test_shares_of_angles_count_half_turns_once() -> None:
    shares = angular_shares(ANGLES)
    np.testing.assert_allclose(shares, np.deg2rad(3.0))
    np.testing.assert_allclose(angular_shares(ANGLES + 360), shares)
    whole = angular_shares(np.arange(-90, 91, 2.0))
    assert whole.sum() == pytest.approx(np.pi)
    assert whole[0] == pytest.approx(whole[1] / 2)
    np.testing.assert_allclose(angular_shares(np.arange(-180, 180, 2.0)).sum(), np.pi)


def test_order_is_restored_and_a_level_taken_off_exactly() -> None:
    images = np.random.default_rng(0).normal(size=(4, 5, 6))
    given = TiltSeries(images, np.array([370.0, -20, 0, 350]), mode="linear")
    found = in_order(given)
    assert found.tilt_angles.tolist() == [-20, -10, 0, 10]
    np.testing.assert_array_equal(found.images, images[[1, 3, 2, 0]])
    low, level = without_level(replace(given, images=images + 2.0**20))
    assert low.images.dtype == np.float32
    np.testing.assert_allclose(low.images.astype(np.float64) + level - 2.0**20, images, atol=1e-6)
    assert without_level(replace(given, mode="transmission"))[1] == 0


def test_the_level_of_a_large_series_takes_little_memory() -> None:
    images = np.random.default_rng(0).normal(100, 1, (24, 400, 400)).astype(np.float32)
    series = TiltSeries(images, np.arange(24.0), mode="linear")
    tracemalloc.start()
    level = level_of(series)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert level == pytest.approx(100, abs=0.01)
    assert peak < images.nbytes / 2


@pytest.mark.parametrize("flips", list(itertools.product((False, True), repeat=3)))
def test_a_volume_in_a_file_is_flipped_there_as_one_in_memory_is(tmp_path, flips):
    volume = np.random.default_rng(0).random((5, 3, 4), np.float32)
    in_file = np.lib.format.open_memmap(tmp_path / "volume.npy", "w+", np.float32, volume.shape)
    in_file[:] = volume
    expected = Orientation(*flips).volume(volume)
    assert Orientation(*flips).volume(in_file) is in_file
    in_file.flush()
    assert np.array_equal(np.load(tmp_path / "volume.npy"), expected)


def test_masked_pixels_have_no_part_in_the_dark_level(small: TiltSeries) -> None:
    mask = np.random.default_rng(0).random(small.images.shape) < 0.97
    spoilt = replace(small, images=np.where(mask, small.images, np.float32(-1e6)), mask=mask)
    assert abs(level_of(spoilt, quantile=0.01) - level_of(small, quantile=0.01)) < 0.05 * float(np.ptp(small.images))
