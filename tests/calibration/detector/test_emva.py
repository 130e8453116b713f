"""EMVA 1288 figures of simulated cameras are those of the simulation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import noiseflow
from calibration.camera import calibrate_camera, write_maps
from calibration.detector.emva import measure_camera
from calibration.detector.levels import NotMeasurable
from calibration.exposures.frames import Burst, read_levels
from calibration.report.page import intervals_of_camera
from calibration.verdict import CalibrationCase, judge
from noiseflow.io import read, write

from .. import simulators as sim

SHAPE = (96, 96)
LEVELS = (200.0, 1000.0, 2500.0, 4500.0, 6500.0, 8200.0, 9500.0)


def camera(seed: int, *, number: int = 4, change=lambda image: image):
    """Flats and darks of gain 2, read noise 3 e⁻, offset 100 ± 2, response 1 ± 1 %, full well 9000 e⁻, dark current 5 e⁻/s."""
    generator = np.random.default_rng(seed)
    response = 1 + 0.01 * generator.standard_normal(SHAPE)
    offset = 100 + 4 * generator.standard_normal(SHAPE)

    def frames(electrons: float) -> Burst:
        made = []
        for _ in range(number):
            charge = np.minimum(generator.poisson(electrons * response), 9000)
            made.append(np.round(change(offset + 2 * (charge + 3 * generator.standard_normal(SHAPE)))))
        return Burst(np.stack(made), calibration=True)

    return [frames(level) for level in LEVELS], [frames(0.0), frames(20.0)], response, offset


def test_figures_are_those_of_the_camera():
    flats, darks, response, offset = camera(0)
    found = measure_camera(flats, darks, flat_times=LEVELS, dark_times=(1.0, 5.0))
    assert found.gain.median == pytest.approx(2.0, rel=0.01)
    assert found.gain.q05 < 2.0 < found.gain.q95
    assert found.dark_noise.median == pytest.approx(3.0, rel=0.02)
    assert found.saturation == pytest.approx(9000, rel=0.1)  # the level nearest below the full well
    assert found.saturated
    assert found.snr_maximum == pytest.approx(np.sqrt(found.saturation), rel=0.03)
    assert found.dynamic_range == pytest.approx(found.saturation / 3.54, rel=0.03)
    assert found.linearity_error < 2e-3
    assert found.dsnu == pytest.approx(2.0, rel=0.05)
    assert found.prnu == pytest.approx(0.01, rel=0.05)
    assert found.dark_current == pytest.approx(5.0, rel=0.05)
    assert np.corrcoef(found.response.ravel(), response.ravel())[0, 1] > 0.7
    assert np.corrcoef(found.dark.image.ravel(), offset.ravel())[0, 1] > 0.7


@pytest.mark.parametrize("rows", [0.0, 0.7])
def test_dark_noise_is_without_that_of_rounding_also_where_rows_have_offsets(rows: float):
    generator = np.random.default_rng(11)

    def frames(electrons: float) -> Burst:
        charge = generator.poisson(electrons, (7, 96, 128)) + 4 * generator.standard_normal((7, 96, 128))
        return Burst(np.round(64 + 0.25 * charge + rows * generator.standard_normal((7, 96, 1))), calibration=True)

    found = measure_camera([frames(level) for level in (500.0, 2000.0, 6000.0)], [frames(0.0)])
    assert (found.rows > 0) == (rows > 0)
    assert found.dark_noise.median == pytest.approx(4.0, rel=0.015)


def test_gain_and_excess_factor_of_an_emccd_are_told_apart():
    generator = np.random.default_rng(1)
    flats = [
        Burst(
            np.stack(
                [
                    sim.multiplied(generator, np.full((128, 128), level), gain=75.0, offset=500.0, read=30.0)
                    for _ in range(6)
                ]
            )
        )
        for level in (0.0, 3.0, 8.0, 20.0)
    ]
    found = measure_camera(flats[1:], flats[:1])
    assert found.gain.median == pytest.approx(150, rel=0.02)
    assert found.excess_factor.q05 < 2.0 < found.excess_factor.q95
    assert found.excess_factor.median == pytest.approx(2.0, rel=0.15)
    calibrated = calibrate_camera(flats[1:], flats[:1])
    assert any(isinstance(module, noiseflow.ExcessNoise) for module in calibrated.model.modules())
    assert "excess-noise factor in the gain" in intervals_of_camera(calibrated)


@pytest.mark.parametrize(("flicker", "prnu"), [(0.05, 0.08), (0.02, 0.0), (0.01, 0.02)])
def test_flicker_of_vignetted_light_is_neither_pattern_nor_correlation_nor_offset_of_rows(flicker: float, prnu: float):
    generator = np.random.default_rng(1)
    y, x = np.mgrid[-1:1:128j, -1:1:128j]
    light = (1 - 0.3 * (x**2 + y**2)) * (1 + prnu * generator.standard_normal((128, 128)))

    def frames(electrons: float) -> Burst:
        steady = 1 + flicker * generator.standard_normal((8, 1, 1))
        charge = generator.poisson(electrons * light * steady) + 1.6 * generator.standard_normal((8, 128, 128))
        return Burst(np.round(100 + 2 * charge), calibration=True)

    calibrated = calibrate_camera([frames(level) for level in (100.0, 800.0, 3000.0, 6500.0)], [frames(0.0)])
    assert calibrated.figures.gain.median == pytest.approx(2.0, rel=0.012)
    assert {finding.reason for finding in calibrated.verdict.findings} == {"unsteady light"}


def test_binned_flats_are_flagged_or_clean_and_filtered_ones_corrected():
    flats, darks, *_ = camera(2, change=lambda image: 0.75 * image + 0.25 * np.roll(image, 1, axis=1))
    found = calibrate_camera(flats[:4], darks[:1])
    assert found.verdict.grade == "doubtful"
    assert "correlated pixels" in [one.reason for one in found.verdict.findings]
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.03)


def test_one_level_alone_tells_no_gain():
    flats, *_ = camera(3)
    with pytest.raises(NotMeasurable, match="one level"):
        measure_camera(flats[:1])


def test_model_and_maps_of_a_camera_describe_its_raw_frames(tmp_path):
    flats, darks, response, offset = camera(4)
    found = calibrate_camera(flats[:4], darks[:1])
    assert found.verdict.grade == "good"
    path = noiseflow.save(found.model, tmp_path / "camera.safetensors")
    model = noiseflow.load(path)
    clean = np.full(SHAPE, 100 + 2 * 3000.0, np.float32)
    drawn = np.stack([np.asarray(model(clean).sample()) for _ in range(16)])
    expected = offset + 2 * 3000.0 * response
    assert np.corrcoef(drawn.mean(0).ravel(), expected.ravel())[0, 1] > 0.6  # the frames' own noise is left in the maps
    assert drawn.var(axis=0, ddof=1).mean() == pytest.approx(4 * (3000 + 9), rel=0.02)
    for written in write_maps(found, path):
        assert read(written).data.shape == SHAPE


def uneven_camera(generator, shape=(64, 64)):
    """A function of electrons and number of frames: bursts of an sCMOS camera whose pixels differ in all; and their read noise,
    electrons."""
    read = 2.0 * generator.lognormal(0.0, 0.7, shape)
    response, offset = 1 + 0.02 * generator.standard_normal(shape), 100 + 3 * generator.standard_normal(shape)

    def frames(electrons: float, number: int) -> Burst:
        made = [
            sim.exposed(generator, electrons * response, gain=2.0, offset=offset, read_noise=read)
            for _ in range(number)
        ]
        return Burst(np.stack(made), calibration=True)

    return frames, read


@pytest.mark.parametrize("number", [4, 16])
def test_saved_model_of_an_scmos_camera_has_the_read_noise_of_each_pixel(tmp_path, number):
    frames, read = uneven_camera(np.random.default_rng(3))
    flats, dark = [frames(level, 4) for level in (20.0, 200.0, 1000.0)], frames(0.0, number)
    found = calibrate_camera(flats, [dark])
    model = noiseflow.load(noiseflow.save(found.model, tmp_path / "camera.safetensors", units="counts"))
    truth, again = (2 * read) ** 2, model.variance.numpy()
    assert np.corrcoef(np.log(again).ravel(), np.log(truth).ravel())[0, 1] > (0.7 if number == 4 else 0.9)
    assert 0.6 < again.mean() / truth.mean() < 1.1
    signal = torch.full((64, 64), float(found.figures.offset) + 2 * 2.0, dtype=torch.float64)
    held_out = torch.from_numpy(frames(2.0, 2).frames[0])
    measured = np.maximum(found.maps["variance"] - 1 / 12, 0.04)
    others = [noiseflow.WithMaps(model.model, model.gain, model.offset, other) for other in (None, measured)]
    with torch.no_grad():
        nats, alike, unsmoothed = (float(one(signal).log_prob(held_out).mean()) for one in (model, *others))
        draws = model(signal).sample((400,), generator=torch.Generator().manual_seed(0))
    assert nats > alike + 0.02
    assert nats > unsmoothed - (0.0 if number == 4 else 0.005)  # many frames need no smoothing, and lose nothing by it
    assert torch.equal(draws, draws.round())
    own, expected = draws.var(0).numpy() - 1 / 12, again + model.gain.numpy() * 2.0**2 * 2.0
    assert np.mean(own / expected) == pytest.approx(1.0, abs=0.03)
    assert np.corrcoef(own.ravel(), expected.ravel())[0, 1] > 0.95


def test_pixels_of_equal_read_noise_get_no_map_of_it():
    assert calibrate_camera(camera(2)[0], camera(2)[1][:1]).model.variance is None


def test_rounding_makes_no_pixels_differ_in_read_noise():
    """The variance of rounded values depends on where between two codes their mean lies."""
    generator = np.random.default_rng(4)
    offset = 10 + generator.random((64, 64))

    def frames(electrons: float, number: int) -> Burst:
        made = [generator.poisson(electrons, offset.shape) + generator.normal(offset, 0.3) for _ in range(number)]
        return Burst(np.round(np.stack(made)), calibration=True)

    found = calibrate_camera([frames(level, 4) for level in (20.0, 100.0, 500.0)], [frames(0.0, 50)])
    assert found.model.variance is None


def test_light_that_leaks_into_dark_frames_adds_to_no_pixels_read_noise():
    generator = np.random.default_rng(4)
    frames, _ = uneven_camera(generator)
    flats, dark = [frames(level, 4) for level in (20.0, 200.0, 1000.0)], frames(0.0, 32)
    drift = 4 * generator.standard_normal((32, 1, 1))
    found, drifted = (
        calibrate_camera(flats, [Burst(each, calibration=True)]) for each in (dark.frames, dark.frames + drift)
    )
    assert drifted.model.variance.mean() == pytest.approx(float(found.model.variance.mean()), rel=0.05)


def test_levels_are_stacks_or_runs_of_equal_single_frames(tmp_path):
    generator = np.random.default_rng(5)
    paths = []
    for number, level in enumerate((100, 100, 300, 300)):
        paths.append(tmp_path / f"{number}.tif")
        write(paths[-1], generator.poisson(level, SHAPE).astype(np.uint16))
    assert [len(level.frames) for level in read_levels(paths)] == [2, 2]
    with pytest.raises(ValueError, match="only one frame"):
        read_levels(paths[:3])


def test_levels_beyond_saturation_tell_the_capacity_and_leave_the_gain_alone():
    """A converter of 12 bits ends at 4095 counts, (4095 − 100) / 2 electrons: levels beyond hold no other value."""
    top = 4095.0
    generator = np.random.default_rng(6)

    def frames(electrons: float) -> Burst:
        made = [sim.exposed(generator, np.full(SHAPE, electrons), top=top) for _ in range(4)]
        return Burst(np.stack(made), calibration=True)

    light = [200.0, 500.0, 900.0, 1400.0, 1800.0, 1990.0, 2100.0, 4000.0, 6000.0]
    flats, dark = [frames(level) for level in light], frames(0.0)
    assert np.ptp(flats[-1].frames) == 0
    found = calibrate_camera(flats, [dark], flat_times=light)
    alone = measure_camera(flats[:3], [dark])  # up to 70 % of the capacity
    assert found.verdict.grade == "good"
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.02)
    assert found.figures.saturated
    assert found.figures.saturation == pytest.approx((top - 100) / 2, rel=0.12)  # the level nearest below
    assert found.figures.linearity_error < 2e-3
    assert found.figures.response.std() == pytest.approx(alone.response.std(), rel=0.1)
    assert float(found.model(torch.full(SHAPE, 5000.0)).sample().max()) == top


def test_flats_that_are_all_saturated_are_refused():
    white = Burst(np.full((2, *SHAPE), 4095.0), calibration=True)
    dark = Burst(np.random.default_rng(7).normal(100, 6, (2, *SHAPE)).round(), calibration=True)
    with pytest.raises(NotMeasurable, match="the noise of all flat frames is clipped"):
        measure_camera([white], [dark])
    with pytest.raises(ValueError, match="flat"):
        measure_camera([Burst(4000 + dark.frames, calibration=True)], [white])


@pytest.mark.parametrize(
    "encoded", [lambda light: light ** (1 / 2.2), lambda light: np.log1p(100 * light) / np.log(101)]
)
@pytest.mark.parametrize("darks", [0, 1])
def test_flats_of_encoded_images_are_refused_for_that(encoded, darks):
    generator = np.random.default_rng(4)

    def frames(electrons: float) -> Burst:
        light = np.stack(
            [sim.exposed(generator, np.full(SHAPE, electrons), offset=40.0, rounded=False) for _ in range(4)]
        )
        return Burst(np.round(255 * encoded(light.clip(0) / 8000)), calibration=True)

    with pytest.raises(NotMeasurable, match="encoded images"):
        measure_camera([frames(level) for level in (100, 400, 1200, 2500)], [frames(0)] * darks)


def test_several_light_levels_in_one_stack_are_told_to_be_separated():
    generator = np.random.default_rng(2)
    frames = [sim.exposed(generator, np.full(SHAPE, level)) for level in (100.0, 500.0, 2500.0) for _ in range(4)]
    dark = Burst(np.stack([sim.exposed(generator, np.zeros(SHAPE)) for _ in range(4)]), calibration=True)
    verdict = calibrate_camera([Burst(np.stack(frames), calibration=True)], [dark]).verdict
    assert verdict.grade != "good"
    assert any("one file for each level" in reason for reason in verdict.reasons)


def test_a_few_codes_of_a_low_gain_are_no_saturation():
    generator = np.random.default_rng(8)

    def frames(electrons: float) -> Burst:
        made = [sim.exposed(generator, np.full(SHAPE, electrons), gain=0.05) for _ in range(4)]
        return Burst(np.stack(made), calibration=True)

    found = calibrate_camera([frames(level) for level in (100.0, 400.0, 1200.0, 3000.0)], [frames(0.0)])
    assert not found.figures.saturated
    assert found.figures.gain.median == pytest.approx(0.05, rel=0.03)
    assert "coarse codes" in [one.reason for one in found.verdict.findings]  # the read noise is 0.15 counts


def test_dark_frames_that_are_cut_off_at_zero_are_flagged():
    generator = np.random.default_rng(9)

    def frames(electrons: float) -> Burst:
        made = [sim.exposed(generator, np.full(SHAPE, electrons), offset=0.0) for _ in range(4)]
        return Burst(np.stack(made), calibration=True)

    found = calibrate_camera([frames(level) for level in (100.0, 400.0, 1200.0)], [frames(0.0)])
    assert "clipped darkness" in [one.reason for one in found.verdict.findings]
    assert found.figures.gain.median == pytest.approx(2.0, rel=0.03)


def test_image_lag_shows_in_flats_of_three_frames():
    flats, darks, _, _ = camera(8, number=3)
    figures = measure_camera(flats, darks)
    assert judge(CalibrationCase(figures.correlation, camera=figures)).grade == "good"
    lagging = []
    for flat in flats:
        kept = np.concatenate([flat.frames[:1], flat.frames[:-1]])
        lagging.append(Burst(np.round(0.94 * flat.frames + 0.06 * kept), calibration=True))
    figures = measure_camera(lagging, darks)
    found = judge(CalibrationCase(figures.correlation, camera=figures)).findings
    assert "frames correlated" in [one.reason for one in found]


@pytest.mark.parametrize("offset", [-3000.0, -108.0, 0.0])
def test_an_offset_below_zero_changes_nothing_but_the_offset(offset: float) -> None:
    flats, darks, _, _ = camera(1)
    moved = [[replace(one, frames=one.frames - 100 + offset) for one in each] for each in (flats, darks)]
    expected, found = measure_camera(flats, darks), measure_camera(*moved)
    assert found.gain.median == pytest.approx(expected.gain.median, rel=1e-6)
    assert found.offset == pytest.approx(expected.offset - 100 + offset)


def test_flats_and_darks_without_any_noise_are_refused():
    frame = np.array([[43.5, 48.0], [49.5, 49.0]])
    flat, dark = (Burst(np.stack([frame + level] * 2), calibration=True) for level in (0, -40))
    with pytest.raises(NotMeasurable, match="noise is clipped or smaller"):
        measure_camera([flat], [dark])
