"""The published reconstruction: its noise model's density, its geometry, and that it trains."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from noiseflow.runs.run_folder import read_state, write_state
from recon.commands.options import method_of
from recon.fields.kinds.network import CoordinateDensity
from recon.joint.checkpoint import run_stage
from recon.methods import method_names
from recon.methods.kniesel2022 import PRESETS, PaperFlow, by_density
from recon.metrics.metrics import compare
from recon.projection.projector import SliceProjector
from recon.series.tilt_series import TiltSeries
from recon.simulate.simulation import Acquisition, clean_tilt_series

SMALL = replace(
    PRESETS["kniesel2022-as-published"],
    normalised=True,
    width=24,
    num_steps=200,
    rays=96,
    accumulate=1,
    coarse_samples=16,
    fine_samples=16,
    field_rate=1.5e-3,
    l2_steps=200,
)


def integral(flow, signal):
    observation = torch.linspace(-100, 100, 200_001, dtype=torch.float64)
    with torch.no_grad():
        density = flow(torch.full_like(observation, signal)).log_prob(observation).exp()
    return float(torch.trapezoid(density, observation))


@pytest.mark.parametrize("signal", [0.1, 0.9])
def test_only_the_corrected_density_integrates_to_one(signal):
    torch.manual_seed(0)
    corrected = PaperFlow().double()
    published = PaperFlow(normalised=False).double()
    published.load_state_dict(corrected.state_dict())
    assert integral(corrected, signal) == pytest.approx(1, abs=1e-3)
    assert abs(integral(published, signal) - 1) > 0.02


def test_flow_inverts_itself():
    torch.manual_seed(1)
    distribution = PaperFlow().double()(torch.linspace(0, 1, 50, dtype=torch.float64))
    latent = torch.linspace(-3, 3, 50, dtype=torch.float64)
    torch.testing.assert_close(
        distribution.to_latent(distribution.from_latent(latent))[0], latent, rtol=1e-7, atol=1e-7
    )


def test_networks_are_those_of_the_paper():
    fine = CoordinateDensity()
    sizes = [(layer.in_features, layer.out_features) for layer in fine.hidden] + [(fine.last.in_features, 1)]
    assert sizes == [(60, 256), *[(256, 256)] * 4, (316, 256), *[(256, 256)] * 3, (256, 1)]
    preset = PRESETS["kniesel2022-as-published"]
    assert (preset.num_steps, preset.coarse_samples, preset.fine_samples) == (400_000, 64, 128)
    assert PRESETS["kniesel2022"].width == preset.width


def test_samples_go_where_the_density_is():
    edges = torch.linspace(0, 0.9, 10).expand(2, -1)
    density = torch.zeros(2, 10)
    density[0, 7] = 1.0
    drawn = by_density(edges, density, 50, torch.Generator().manual_seed(0))
    assert drawn.shape == (2, 60)
    assert (drawn[0, 10:] == edges[0, 7]).all()
    assert len(drawn[1, 10:].unique()) == 10


def test_rays_see_what_the_projector_projects():
    size, angles = 32, np.array([-50.0, 0.0, 30.0])
    z, y, x = (np.indices((size,) * 3) + 0.5) * 2 / size - 1
    density = np.exp(-((x - 0.3) ** 2 + (y + 0.2) ** 2 + (z - 0.1) ** 2) / 0.05).astype(np.float32)
    images = (
        SliceProjector(tilt_angles=angles, depth=size, width=size)(torch.from_numpy(density)).numpy() * 7 * 2 / size
    )
    state = replace(SMALL, rays=400, coarse_samples=400).start(TiltSeries(np.exp(-images), angles))
    state.images = torch.from_numpy(np.exp(-images))

    class Blob(torch.nn.Module):
        def forward(self, points):
            centre = torch.tensor([0.3, -0.2, 0.1])
            return torch.exp(-((points - centre) ** 2).sum(-1) / 0.05)

    origin, direction, observed = state._rays()
    edges = (torch.arange(400) / 400 * 2 * 2**0.5 - 2**0.5).expand(400, -1)
    predicted = state._signal(Blob(), origin, direction, edges)
    torch.testing.assert_close(predicted, observed, rtol=0, atol=0.02)


@pytest.fixture(scope="module")
def ball():
    """A ball, its noise-free series, and the unit of the volume."""
    z, y, x = (np.indices((16,) * 3) + 0.5) * 2 / 16 - 1
    density = (x**2 + y**2 + (z - 0.2) ** 2 < 0.3).astype(np.float32)
    acquisition = Acquisition(None, peak=1.5, intensity=3.0)
    return density, *clean_tilt_series(density, np.arange(-60, 61, 6.0), acquisition=acquisition)


@pytest.mark.parametrize(
    "preset", [SMALL, replace(SMALL, rays=None, num_steps=100, l2_steps=100)], ids=["rays", "voxels"]
)
def test_preset_trains(preset, ball):
    density, series, unit = ball
    *_, state = preset.train(series)
    empty = compare(np.zeros_like(density), density).psnr
    assert compare(state.volume() / unit, density).psnr > empty + 2


def test_the_first_steps_of_the_likelihood_keep_what_least_squares_found(ball):
    _, series, _ = ball
    noise = np.random.default_rng(0).normal(0, 0.2, series.images.shape)
    preset = replace(PRESETS["kniesel2022"], width=24, l2_steps=60, num_steps=70)
    clean = torch.from_numpy(series.images).float().mT / 3.0
    states = preset.train(replace(series, images=series.images + noise))
    errors = [float((state._signal_of_voxels().detach() - clean).square().mean()) for state in states]
    assert errors[-1] < errors[59]
    assert max(errors[60:]) < 2 * errors[59]


def test_a_linear_series_is_refused():
    series = TiltSeries(np.random.default_rng(0).random((3, 8, 8)), np.array([-30.0, 0.0, 30.0]), mode="linear")
    with pytest.raises(ValueError, match="bright-field"):
        SMALL.start(series)


def test_noise_model_learns_after_the_field():
    series, _ = clean_tilt_series(np.ones((12,) * 3, np.float32), np.arange(-60, 61, 12.0))
    states = replace(SMALL, l2_steps=2).train(series, max_steps=4)
    before = [parameter.clone() for parameter in next(states).noise_model.parameters()]
    *_, last = states
    assert any(not torch.equal(one, other) for one, other in zip(before, last.noise_model.parameters(), strict=True))
    assert last.done == 4


def test_on_voxels_the_noise_model_learns_the_residuals_of_least_squares():
    series, _ = clean_tilt_series(np.ones((12,) * 3, np.float32), np.arange(-60, 61, 12.0))
    states = replace(SMALL, rays=None, l2_steps=2).train(series, max_steps=2)
    before = [parameter.clone() for parameter in next(states).noise_model.parameters()]
    *_, last = states
    assert any(not torch.equal(one, other) for one, other in zip(before, last.noise_model.parameters(), strict=True))


def test_a_state_goes_on_as_if_never_stopped(tmp_path):
    series, _ = clean_tilt_series(np.ones((12,) * 3, np.float32), np.arange(-60, 61, 12.0))
    preset = replace(SMALL, l2_steps=2)
    *_, whole = preset.train(series, max_steps=6)
    *_, first = preset.train(series, max_steps=3)
    write_state(tmp_path / "state.safetensors", first.state())
    second = preset.start(series, max_steps=6)
    second.load_state(read_state(tmp_path / "state.safetensors"))
    run_stage("", second)
    for part in ("fine", "noise_model"):
        for one, other in zip(getattr(second, part).parameters(), getattr(whole, part).parameters(), strict=True):
            torch.testing.assert_close(one, other)


def test_presets_are_methods():
    assert set(PRESETS) <= set(method_names())


def test_command_line_takes_a_preset_or_a_method():
    assert method_of("auto", "kniesel2022") == method_of("kniesel2022", None) == "kniesel2022"
    assert method_of("tv", None) == "tv"
    with pytest.raises(ValueError, match="choose kniesel2022 or kniesel2022-as-published"):
        method_of("auto", "nerf")
    with pytest.raises(ValueError, match="remove --method tv"):
        method_of("tv", "kniesel2022")
