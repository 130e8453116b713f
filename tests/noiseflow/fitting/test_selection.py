"""Detection of rounding and clipping limits, choice of models, divergence from a known truth, and residual structure."""

import math

import numpy as np
import pytest
import torch

import noiseflow
from benchmarks.divergences import kl_divergence
from benchmarks.pages.noise_laws import divergence, laws
from noiseflow.distributions.laws.base import LatentDistribution
from noiseflow.fitting import contest
from noiseflow.fitting.selection import Candidate, select, simplest_sufficient
from noiseflow.metrics.spatial import spatial_structure
from noiseflow.models.standardisation import Standardisation


def noisy(seed: int = 0, count: int = 60_000) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    signal = torch.rand(count, generator=generator)
    return signal, signal + 0.1 * torch.randn(count, generator=generator)


def test_simplest_sufficient_model_is_chosen() -> None:
    signal, observation = noisy(count=20_000)
    found = select(signal, observation, num_steps=50)
    assert found.chosen.name == "Gaussian"
    assert found.digitisation == noiseflow.Digitisation()
    few = {"Gaussian": noiseflow.Gaussian(), "SplineFlow": noiseflow.SplineFlow()}
    clipped = select(signal, observation.clamp(0, 1), candidates=few, num_steps=30)
    assert isinstance(clipped.chosen.model, noiseflow.Digitised)


def test_candidates_start_without_the_scatter_of_single_levels() -> None:
    candidates = {"flow": noiseflow.SignalDependentGaussian()}
    model = select(*noisy(), candidates=candidates, num_steps=1, refit=False).chosen.model
    (scale,) = (part for part in model.modules() if isinstance(part, Standardisation))
    # a level has 2800 pixels, which know its scale within 2 %
    assert float((scale.log_scale - math.log(0.1)).square().mean().sqrt()) < 0.01


def test_resolved_electrons_choose_the_physical_model() -> None:
    truth = noiseflow.PoissonGaussian(2.0, 100.0, 0.2)
    signal = 100 + 12 * torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    found = select(signal, truth(signal).sample(generator=torch.Generator().manual_seed(1)), num_steps=50)
    assert found.chosen.name == "PoissonGaussian"
    assert {candidate.name for candidate in found.candidates if candidate.screened_out} >= {"Gaussian", "Mixture8"}
    assert kl_divergence(truth, found.chosen.model, signal)[0] < 0.005


@pytest.mark.parametrize(("slope", "searched"), [(1.0, 0), (0.3, 1)])
def test_a_detector_behind_is_searched_for_on_few_pixels_or_not(
    monkeypatch: pytest.MonkeyPatch, slope: float, searched: int
) -> None:
    generator, sizes = torch.Generator().manual_seed(0), list[int]()
    search = noiseflow.ExcessNoise.settle
    monkeypatch.setattr(
        noiseflow.ExcessNoise, "settle", lambda model, *given: (sizes.append(len(given[0])), search(model, *given))
    )
    signal = torch.rand(30_000, generator=generator)
    gamma = -torch.log(torch.rand((30, *signal.shape), generator=generator)).sum(0)
    candidates = {"mixture": noiseflow.Mixture(4), "excess": noiseflow.ExcessNoise()}
    found = select(signal, signal + 0.1 * (gamma - 30) * (1.5 - slope * signal), candidates=candidates, num_steps=60)
    assert found.chosen.name == "mixture"
    assert len(sizes) == searched
    assert all(size < 10_000 for size in sizes)


def test_the_last_fit_goes_on_from_the_chosen_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    anew, learn = list[bool](), contest.fit
    monkeypatch.setattr(
        contest, "fit", lambda *given, **options: (anew.append(options["standardise"]), learn(*given, **options))[1]
    )
    select(*noisy(count=20_000), candidates={"mixture": noiseflow.Mixture(4)}, num_steps=40)
    assert anew == [True, False]


def test_model_of_learnt_shape_is_chosen_for_skewed_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(20_000, generator=generator)
    gamma = -torch.log(torch.rand((2, *signal.shape), generator=generator)).sum(0)
    found = select(signal, signal + 0.1 * (gamma - 2), num_steps=100)
    entropy = 2 + math.log(0.1) - (1 - 0.5772156649)  # of a gamma law of shape 2: its digamma is 1 − γ
    assert found.chosen.nll == pytest.approx(entropy, abs=0.015)
    by_name = {candidate.name: candidate for candidate in found.candidates}
    assert by_name["Gaussian"].excess > 0.05


def test_kl_divergence_of_gaussians_is_the_formula() -> None:
    signal = torch.rand(400_000, generator=torch.Generator().manual_seed(0))
    found, error = kl_divergence(noiseflow.Gaussian(0.1), noiseflow.Gaussian(0.12), signal)
    exact = math.log(1.2) + 1 / (2 * 1.44) - 0.5
    assert found == pytest.approx(exact, abs=4 * error)
    assert kl_divergence(noiseflow.Gaussian(0.1), noiseflow.Gaussian(0.1), signal)[0] == 0


def test_an_image_of_one_row_has_no_neighbours_across() -> None:
    found = spatial_structure(noiseflow.Gaussian(), np.zeros((1, 9)), np.tile([0.1, -0.1, 0.1], (1, 3)))
    assert found.vertical == 0
    assert "nan" not in found.in_words()


@pytest.mark.parametrize("kind", ["none", "rows", "neighbours"])
def test_spatial_structure_is_seen(kind: str) -> None:
    generator = torch.Generator().manual_seed(0)
    signal, noise = torch.rand((200, 300), generator=generator), torch.randn((200, 300), generator=generator)
    if kind == "rows":
        noise = noise + 0.3 * torch.randn((200, 1), generator=generator)
    elif kind == "neighbours":
        noise = noise + 0.2 * torch.roll(noise, 1, dims=1)
    found = spatial_structure(noiseflow.Gaussian(float(noise.std()) * 0.1), signal, signal + 0.1 * noise)
    assert found.suffices == (kind == "none")
    if kind == "rows":
        assert found.rows == pytest.approx(1 + 0.09 * 300, rel=0.3)
    elif kind == "neighbours":
        assert found.horizontal == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("kind", "remedy"),
    [
        ("rows", "ScanNoise(model) adds"),
        ("columns", 'along="column"'),
        ("pattern", "WithMaps"),
        ("neighbours", "Correlated"),
    ],
)
def test_the_term_that_would_help_is_named(kind: str, remedy: str) -> None:
    generator = torch.Generator().manual_seed(0)
    signal, noise = torch.rand((3, 80, 100), generator=generator), torch.randn((3, 80, 100), generator=generator)
    if kind == "neighbours":
        noise = noise + 0.3 * torch.roll(noise, 1, dims=2)
    else:
        shape = {"rows": (3, 80, 1), "columns": (3, 1, 100), "pattern": (80, 100)}[kind]
        noise = noise + 0.3 * torch.randn(shape, generator=generator)
    observation = signal + 0.1 * noise
    found = spatial_structure(noiseflow.Gaussian(0.1 * float(noise.std())), signal, observation)
    assert len(found.remedies) == 1
    assert remedy in found.remedies[0]
    assert remedy in found.in_words()
    if kind == "rows":
        assert spatial_structure(noiseflow.ScanNoise(noiseflow.Gaussian(0.1), 0.03), signal, observation).suffices


class SlowLogNormal(noiseflow.NoiseModelBase):
    """Log-normal noise that starts at a width far too large and does not measure the data."""

    def __init__(self, width: float = 30.0) -> None:
        super().__init__()
        self.log_width = torch.nn.Parameter(torch.tensor(width).log())

    def forward(self, signal: torch.Tensor) -> "LogNormalDistribution":
        return LogNormalDistribution(signal, self.log_width.exp())


class LogNormalDistribution(LatentDistribution):
    def __init__(self, signal: torch.Tensor, width: torch.Tensor) -> None:
        super().__init__(signal.shape)
        self.signal, self.width = signal, width

    def to_latent(self, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.log(value / self.signal) / self.width, -torch.log(value * self.width)

    def from_latent(self, latent: torch.Tensor) -> torch.Tensor:
        return self.signal * torch.exp(self.width * latent)


def test_slow_model_is_not_beaten_by_not_having_converged() -> None:
    signal = 1 + torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    observation = SlowLogNormal(0.5)(signal).sample(generator=torch.Generator().manual_seed(1))
    own = {"Gaussian": noiseflow.Gaussian(), "own": SlowLogNormal()}
    found = select(signal, observation, candidates=own, num_steps=100)
    assert found.chosen.name == "own"
    assert float(found.chosen.model.log_width.detach().exp()) == pytest.approx(0.5, rel=0.03)
    assert found.chosen.learning_rate > SlowLogNormal().learning_rate


def test_own_rate_and_steps_of_a_model_are_used() -> None:
    class Quick(SlowLogNormal):
        learning_rate = 0.5
        num_steps = 200

    signal = 1 + torch.rand(4000, generator=torch.Generator().manual_seed(0))
    observation = Quick(0.5)(signal).sample(generator=torch.Generator().manual_seed(1))
    model = Quick()
    result = noiseflow.fit(model, signal, observation)
    assert result.num_steps == 200
    assert float(model.log_width.detach().exp()) == pytest.approx(0.5, rel=0.05)


def test_judging_pixels_and_unusable_ones_are_not_learnt_from() -> None:
    signal, observation = noisy(count=20_000)
    apart, unused = torch.zeros(20_000, dtype=torch.bool), torch.zeros(20_000, dtype=torch.bool)
    apart[::4], unused[1::4] = True, True
    observation[unused] = 1e6
    wide = torch.where(apart, signal + 3 * (observation - signal), observation)
    found = select(
        signal,
        wide,
        candidates={"Gaussian": noiseflow.Gaussian()},
        mask=~unused,
        held_out=apart,
        num_steps=20,
        refit=False,
    )
    assert float(found.chosen.model.log_scale.detach().exp()) == pytest.approx(0.1, rel=0.03)
    width = found.chosen.model.log_scale.detach().double().exp()
    expected = torch.log(width * math.sqrt(2 * math.pi)) + ((wide - signal)[apart] / width).square().mean() / 2
    assert found.chosen.nll == pytest.approx(float(expected), rel=1e-4)


def test_error_of_pixels_that_err_alike_comes_from_their_blocks() -> None:
    """Blocks of 50 equal pixels tell no more than one pixel each: the standard error is √50 times larger."""
    generator = torch.Generator().manual_seed(0)
    signal = 2 + torch.rand(400, generator=generator).repeat_interleave(50)
    observation = signal + 0.1 * torch.randn(400, generator=generator).repeat_interleave(50)
    blocks = torch.arange(400).repeat_interleave(50)

    def error(**options: torch.Tensor) -> float:
        models = {"narrow": SlowLogNormal(0.05).requires_grad_(False), "true": noiseflow.Gaussian()}
        found = select(signal, observation, candidates=models, num_steps=5, refit=False, **options)
        return next(each.excess_error for each in found.candidates if each.excess > 0)

    held_out = torch.arange(20_000) % 100 < 50
    ratio = error(blocks=blocks, held_out=held_out) / error(held_out=held_out)
    assert ratio == pytest.approx(math.sqrt(50), rel=0.1)


def test_image_models_are_compared_on_whole_rows() -> None:
    generator = torch.Generator().manual_seed(0)
    signal = torch.rand(64, 60, generator=generator)
    observation = (
        signal + 0.1 * torch.randn(64, 60, generator=generator) + 0.1 * torch.randn(64, 1, generator=generator)
    )
    models = {"Gaussian": noiseflow.Gaussian(), "rows": noiseflow.ScanNoise(noiseflow.Gaussian())}
    found = select(signal, observation, candidates=models, num_steps=40)
    assert found.chosen.name == "rows"
    assert float(found.chosen.model.log_scale.detach().exp()) == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize(
    ("excess", "error", "count", "chosen"),
    [
        ((0.00028, 0.0), (0.001, 0.0), 10**6, "simple"),
        ((0.0003, 0.0), (0.00025, 0.0), 10**6, "best"),
        ((0.0004, 0.0), (0.001, 0.0), 10**6, "best"),
        ((0.0004, 0.0), (0.001, 0.0), 10**4, "best"),
        ((0.0006, 0.0), (0.001, 0.0), 10**3, "simple"),
        ((0.0001, 0.0), (0.0, 0.0), 10**6, "simple"),
    ],
)
def test_one_rule_says_which_model_suffices(excess: tuple, error: tuple, count: int, chosen: str) -> None:
    named = zip(("simple", "best"), excess, error, strict=True)
    candidates = [
        Candidate(name, noiseflow.Gaussian(), 0.0, 0.0, *figures, 0.0, False, 0.0) for name, *figures in named
    ]
    assert simplest_sufficient(candidates, count).name == chosen


def test_selection_asks_for_candidates_that_can_explain_the_data() -> None:
    signal, observation = noisy(count=2000)
    with pytest.raises(ValueError, match="candidates"):
        select(signal, observation, candidates={})
    with pytest.raises(ValueError, match="equal"):
        select(signal, observation[:-1])
    with pytest.raises(ValueError, match="held_out"):
        select(signal, observation, held_out=1.0)


class _Wide(noiseflow.NoiseModelBase):
    """Student's distribution that starts thirty times too narrow and has no rate of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.log_width = torch.nn.Parameter(torch.tensor(0.0))

    def forward(self, signal: torch.Tensor) -> torch.distributions.Distribution:  # type: ignore[override]
        return torch.distributions.StudentT(2.5, signal, self.log_width.exp(), validate_args=False)


def _student() -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    signal = 100 + 50 * torch.rand(8000)
    return signal, signal + 30 * torch.distributions.StudentT(2.5).sample(signal.shape)


@pytest.mark.parametrize("num_steps", [1, 12, 24])
def test_a_fit_of_few_steps_takes_them(num_steps: int) -> None:
    model = _Wide()
    result = noiseflow.fit(model, *_student(), num_steps=num_steps)
    assert result.num_steps == num_steps
    assert model.log_width.item() > 0


def test_a_given_number_of_steps_is_taken_even_without_a_gain() -> None:
    result = noiseflow.fit(noiseflow.Mixture(2), *noisy(count=2000), num_steps=200)
    assert result.num_steps == 200
    assert noiseflow.fit(noiseflow.Mixture(2), *noisy(count=2000)).num_steps < 200


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_models_that_rest_on_plateaus_are_fitted_to_their_end(seed: int) -> None:
    law = laws()["three-by-value"]
    pixels = (torch.from_numpy(each.astype(np.float32)) for each in law.data(50_000, seed))
    chosen = noiseflow.select(*pixels, seed=seed).chosen
    assert divergence(law, chosen.model) < 0.0042  # stopped on the way, 0.0051; of a Gaussian, 0.0096


def test_a_last_fit_that_few_pixels_would_stop_is_left_out() -> None:
    law = laws()["rice"]
    pixels = (torch.from_numpy(each.astype(np.float32)) for each in law.data(500, 0))
    assert divergence(law, noiseflow.select(*pixels).chosen.model) < 0.025  # with it, 0.042


def test_users_model_far_from_its_start_is_chosen_within_few_steps() -> None:
    candidates = {"Gaussian": noiseflow.Gaussian(), "Student": _Wide()}
    assert noiseflow.select(*_student(), candidates=candidates, num_steps=60).chosen.name == "Student"


def test_candidates_without_names_are_refused() -> None:
    for candidates in ({}, [noiseflow.Gaussian()], "gaussian"):
        with pytest.raises(ValueError, match="by name"):
            noiseflow.select(torch.rand(100), torch.rand(100), candidates=candidates)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_flow_behind_a_detector_is_not_tried_where_a_detector_has_the_shape_of_the_noise() -> None:
    random = np.random.default_rng(0)
    signal = random.uniform(20, 200, 20_000)
    observation = (10 * random.gamma(2 * random.poisson(signal / 10)) / 2).round()
    found = noiseflow.select(signal.astype(np.float32), observation.astype(np.float32))
    assert found.chosen.name == "ExcessNoise"
    assert "PhysicsFlow" not in [each.name for each in found.candidates]


@pytest.mark.slow
def test_edges_of_codes_are_fitted_to_all_pixels() -> None:
    """A model of three parameters behind a converter that lacks every fourth code: each edge is a parameter, too."""
    generator = torch.Generator().manual_seed(0)

    def draw(count: int) -> tuple[torch.Tensor, torch.Tensor]:
        signal = 20 + 40 * torch.rand(count, generator=generator)
        code = (signal + 4 * torch.randn(count, generator=generator)).round()
        return signal, code - (code.remainder(4) == 3).float()

    pixels, fresh = draw(6000), draw(100_000)
    nll = []
    for refit in (False, True):
        chosen = noiseflow.select(*pixels, candidates={"": noiseflow.Gaussian()}, refit=refit).chosen.model
        nll.append(-float(noiseflow.metrics.pixel_log_prob(chosen, *fresh).mean()))
    assert nll[1] < nll[0] - 2e-4


def test_the_best_model_is_chosen_though_one_that_lost_since_had_screened_it_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(contest.Contest, "_complete", lambda it, name: it.screened_out.add(name))
    candidates = {"Gaussian": noiseflow.Gaussian(), "wide": noiseflow.SignalDependentGaussian()}
    assert select(*noisy(count=4000), candidates=candidates).chosen.name in candidates


def test_models_of_many_pixels_are_compared_on_some_and_fitted_to_all(monkeypatch: pytest.MonkeyPatch) -> None:
    compared, fitted = [], []
    learn_all, screen = contest.Contest.learn_all, contest.Contest.screen
    monkeypatch.setattr("noiseflow.fitting.selection.ENOUGH", 3000)
    monkeypatch.setattr(contest.Contest, "screen", lambda it: (compared.append(it.pixels), screen(it))[1])
    monkeypatch.setattr(
        contest.Contest, "learn_all", lambda it, name, all_: (fitted.append(all_), learn_all(it, name, all_))[1]
    )
    found = select(*noisy(count=40_000), candidates={"Gaussian": noiseflow.Gaussian()})
    (some,), (whole,) = compared, fitted
    numbers = [int(some.judge.sum()), int((some.use & ~some.judge).sum()), int(whole.use.sum())]
    assert numbers == pytest.approx([3000, 3000, 40_000], abs=300)
    assert found.chosen.nll_error > 0.01  # of 3000 pixels; of 8000 it is 0.008


def test_a_model_of_neighbours_may_lead() -> None:
    random = torch.Generator().manual_seed(0)
    signal = 10 + 90 * torch.rand(6, 48, 64, generator=random)
    width = 1 + 0.05 * torch.nn.functional.avg_pool2d(signal, 3, 1, 1)
    observation = signal + width * torch.randn(signal.shape, generator=random)
    mask = torch.rand(signal.shape, generator=random) < 0.9
    models = {f"{side}": noiseflow.SignalDependentGaussian(neighbourhood=side) for side in (1, 3)}
    assert noiseflow.select(signal, observation, mask=mask, candidates=models, num_steps=60).chosen.name == "3"


@pytest.mark.parametrize("skewed", [1.0, 4.0])
def test_models_are_compared_under_all_conditions(skewed: float) -> None:
    generator = torch.Generator().manual_seed(0)
    gain, signal = torch.tensor([1.0, 2.0, 4.0]).repeat(2000), 10 + torch.rand(6000, generator=generator)
    normal = torch.randn(6000, generator=generator)
    noise = gain * torch.where(gain == skewed, -torch.log(torch.special.ndtr(normal)) - 1, normal)
    candidates = {"Gaussian": noiseflow.Gaussian(), "Mixture": noiseflow.Mixture(4, shared_shape=True)}
    found = select(signal, signal + noise, condition={"gain": gain}, candidates=candidates, num_steps=60)
    assert found.chosen.name == "Mixture"  # of the pixels of most gains, a Gaussian
    assert found.chosen.model.ranges == {"gain": (1.0, 4.0)}
    for each in (1.0, 4.0):
        spread = float(found.chosen.model(torch.tensor(10.5), condition={"gain": each}).stddev)
        assert spread == pytest.approx(each, rel=0.1)
    simple = select(signal, signal + gain * normal, condition={"gain": gain}, candidates=candidates, num_steps=60)
    assert simple.chosen.name == "Gaussian"


def test_images_under_conditions_are_refused() -> None:
    candidates = {"rows": noiseflow.ScanNoise(noiseflow.Gaussian())}
    with pytest.raises(ValueError, match="conditions"):
        select(torch.rand(20, 20), torch.rand(20, 20), condition={"gain": 1.0}, candidates=candidates)
