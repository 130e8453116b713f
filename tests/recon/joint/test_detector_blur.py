"""The blur of a detector: how it is modelled, and that the correlation of its noise shows it."""

import numpy as np
import pytest
import torch
from scipy import ndimage, signal

import noiseflow
from recon.fields.kinds.grids import VoxelField
from recon.joint.joint import JointReconstructor
from recon.joint.signal_model import TomographySignal
from recon.joint.task import Task
from recon.projection.image_formation import Linear, Transmission
from recon.projection.projector import SliceProjector
from tests.independent_scenes import independent_series

pytestmark = pytest.mark.usefixtures("one_thread")


def blurred(sigma):
    def noise(clean, random):
        return ndimage.gaussian_filter(random.poisson(40 * clean).astype(float), (0, sigma, sigma)), 40.0

    return noise


@pytest.mark.parametrize("response", [Linear(gain=3.0, offset=2.0), Transmission(5.0, offset=1.0)])
def test_a_blurred_signal_is_the_gaussian_of_the_sharp_one(response):
    lines = torch.rand(2, 40, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    response.double()
    sharp = response(lines).detach().numpy()
    response.blur.fill_(0.9)
    expected = ndimage.gaussian_filter(sharp, (0, 0.9, 0.9), truncate=8)
    np.testing.assert_allclose(response(lines).detach()[:, 8:-8, 8:-8], expected[:, 8:-8, 8:-8], rtol=1e-6)
    level = response(torch.zeros(1, 4, 4, dtype=torch.float64)).detach()
    torch.testing.assert_close(level, torch.full_like(level, float(level[0, 0, 0])))


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [((0.6, 0.6), 0.6), ((0.8, 0.8), 0.8), ((1.2, 1.2), 1.2), ((0, 0), 0.0), ((0, 1.5), 0.0)],
)
def test_the_correlation_of_neighbours_shows_the_blur_but_not_that_of_rows(sigma, expected):
    projector = SliceProjector(tilt_angles=np.arange(-60, 61, 4.0), depth=40, width=40)
    model = TomographySignal(VoxelField((40, 40, 40), scale=0.1), projector, Linear())
    white = np.random.default_rng(0).normal(size=(31, 40, 40))
    observation = torch.from_numpy(ndimage.gaussian_filter(white, (0, *sigma), mode="wrap")).float()
    task = Task(model, observation + model.signal().detach().view(31, 40, 40), None, observation > 1)
    noise = noiseflow.Gaussian(float(observation.std()))
    assert task.blur_of_noise(noise) == pytest.approx(expected, rel=0.05, abs=0.35)
    if expected:
        assert task.blur_of_noise(noise) == pytest.approx(expected, rel=0.1)


def test_misfit_whose_correlation_falls_slowly_is_no_blur():
    projector = SliceProjector(tilt_angles=np.arange(-60, 61, 4.0), depth=40, width=40)
    model = TomographySignal(VoxelField((40, 40, 40), scale=0.1), projector, Linear())
    misfit = np.random.default_rng(0).normal(size=(31, 40, 40))
    for axis in (1, 2):  # second neighbours correlate by the square of neighbours
        misfit = signal.lfilter([1.0], [1.0, -0.7], misfit, axis=axis)
    observation = torch.from_numpy(misfit).float()
    task = Task(model, observation + model.signal().detach().view(31, 40, 40), None, observation > 1)
    assert task.blur_of_noise(noiseflow.Gaussian(float(observation.std()))) == 0


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rows", [1, 2, 5])
def test_white_noise_of_few_rows_has_no_blur(rows):
    projector = SliceProjector(tilt_angles=np.arange(-60, 61, 4.0), depth=40, width=40)
    model = TomographySignal(VoxelField((40, rows, 40), scale=0.1), projector, Linear())
    clean = model.signal().detach().view(31, 40, rows)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    assert Task(model, clean + noise, None, clean > 1).blur_of_noise(noiseflow.Gaussian(1.0)) < 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "tilts", "gain"), [("beads", "±50°/10°", 2), ("gyroid", "±60°/2°", 1.5)])
def test_a_blur_is_found_and_its_volume_is_sharper(scene, tilts, gain):
    made = independent_series(scene, blurred(0.8), tilts)
    found, without = (JointReconstructor(detector_blur=blur)(made.series) for blur in (None, 0.0))
    assert float(found.signal_model.image_formation.blur) == pytest.approx(0.8, rel=0.15)
    errors = [np.mean((each.volume.attenuation - made.truth) ** 2) for each in (found, without)]
    assert errors[0] < errors[1] / gain


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["Poisson 10", "scan noise"])
def test_independent_noise_and_noise_of_rows_are_no_blur(noise):
    made = independent_series("beads", noise, "±50°/10°")
    assert float(JointReconstructor()(made.series).signal_model.image_formation.blur) == 0


@pytest.mark.filterwarnings("error")
def test_vacuum_without_any_noise_tells_nothing_of_a_blur():
    projector = SliceProjector(tilt_angles=np.arange(-60, 61, 4.0), depth=40, width=40)
    model = TomographySignal(VoxelField((40, 40, 40), scale=1.0), projector, Linear())
    clean = torch.zeros(31, 40, 40)
    clean[:, 10:30, 10:30] = 9.0
    counts = torch.poisson(clean, generator=torch.Generator().manual_seed(0))
    task = Task(model, counts, None, clean > 1)
    task.signal = lambda: clean  # no counts at all in vacuum
    assert task.blur_of_noise(noiseflow.Poisson()) < 0.4
