"""The runner of a plan, which executes its stages one by one; the journal stores each under its name; what it has settled."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from noiseflow import Digitised, FitResult, Gaussian, KnownSignal, fit
from noiseflow.fitting.contest import mean_and_error
from noiseflow.fitting.signal_models import choose_weight
from noiseflow.fitting.steps import WeightChoice
from noiseflow.models.wrapper import as_noise_model
from noiseflow.progress import Progress
from noiseflow.statistics import STANDARD_ERRORS
from recon.fields.regularisers.base import Regulariser
from recon.joint.coarse_start import Start
from recon.joint.plan import Facts, FitStage, total_steps
from recon.joint.signal_model import TomographySignal
from recon.joint.task import BATCH, Task
from recon.joint.vacuum import vacuum_level, vacuum_pixels
from recon.projection.image_formation import Linear, Transmission

MakeCandidates = Callable[[Task, Tensor], list[nn.Module]]
_Gains = Callable[[FitStage, Task, Regulariser], tuple[Tensor, Tensor]]

_WARM_UP = 0.1  # share of the steps
# Nats per pixel; smaller gains of a more flexible noise model may come from absorbed errors of the signal
_TOLERATED = 0.003
_LEAST_BLUR = 0.4  # pixels: neighbours correlate by 0.2
# signals then differ by 2.5 % of the brightest from a straight response. Standard errors of 19 true bends were 0.06 to 0.46;
# of films that the missing wedge hides (2 counts; up to 4.5 dB lost), a tilt axis along x and angles in radians 0.53 to 2.3
_LEAST_BEND, _MOST_ERROR = 0.2, 0.5
# Of a bend, after it is modelled: at most 0.5 of 14 true ones, 0.8 to 1.3 of misfit of round objects, which absorb any bend
_MOST_LEFT = 0.7


@dataclass(frozen=True, eq=False)
class _TriedModel:
    """A candidate and its log-likelihoods of the held-out pixels, (P,)."""

    model: nn.Module
    scores: Tensor


RunFit = Callable[..., FitResult]
"""Runs one fit, arguments as for `run_fit`; a journal also stores its result under its name."""


def run_fit(
    name: str, noise_model: nn.Module, signal: Tensor | nn.Module, observation: Tensor, **options: Any
) -> FitResult:
    """`noiseflow.fit` as a `RunFit` that stores nothing."""
    del name
    return fit(noise_model, signal, observation, **options)


@dataclass
class Runner:
    """Executes the stages of a plan: first the choices on the slab, then the fit of the volume.

    Attributes:
        tasks: signal models and pixels of the ``slab`` and of the ``whole``.
        models: the ``simple`` noise model, and the ``chosen`` one if known; fitted in place. Stages of the plan make the
            ``even`` one, unless it is known.
        candidates: makes the candidate noise models for a task and its signal, simplest first.
        least_vacuum: attenuation, in units of the field's scale, below which a coarse volume may be vacuum; by default, none
            is looked for.
        least_signal: the lowest signal that a noise model allows, detector units.
        regularisers: regularisers to compare with that of the tasks when the weight is chosen.
        find_blur: whether to look for a blur of the detector when the weight is chosen.
        weight_choice: the compared weights, after the comparison.
    """

    facts: Facts
    stages: list[FitStage]
    tasks: Mapping[str, Task]
    models: dict[str, nn.Module]
    generator: torch.Generator
    candidates: MakeCandidates = lambda task, signal: []
    least_vacuum: float = -math.inf
    least_signal: Callable[[nn.Module], float] | None = None
    regularisers: Sequence[Regulariser] = ()
    find_blur: bool = False
    first_weight: float = math.nan
    run_fit: RunFit = run_fit
    prefix: str = ""
    progress: Progress | None = None
    weight_choice: WeightChoice | None = None
    result: FitResult = field(init=False)

    def __post_init__(self) -> None:
        self.result = FitResult(self.models["simple"])
        self._simpler: list[nn.Module] = []  # the noise models simpler than the chosen one, simplest first
        self._remembered: dict[str, Tensor] = {}
        # where the slab shows vacuum, the beam there, and the pixel values with the beam of each
        self._vacuum: tuple[Tensor, Tensor, tuple[Tensor, Tensor]] | None = None
        self._done, self._expected = 0, total_steps(self.stages)

    @property
    def noise_model(self) -> nn.Module:
        """The chosen noise model."""
        return self.models["simple" if self.facts.simple_is_final and not self.facts.quiet else "chosen"]

    @property
    def likelihood(self) -> nn.Module:
        """The noise model of the final fit of the volume; the chosen one if no fit was needed."""
        last = [stage for stage in self.stages if stage.kind == "signal"][-1:]
        return self.models[last[0].noise] if last else self.noise_model

    def choose(self) -> None:
        """Execute the stages on the slab; the whole volume starts from the response found there."""
        self._coarse = copy.deepcopy(self.tasks["slab"].signal_model.state_dict())
        self._execute("slab")
        slab, whole = (self.tasks[where].signal_model for where in ("slab", "whole"))
        whole.image_formation.load_state_dict(copy.deepcopy(slab.image_formation.state_dict()))

    def fit_whole(self) -> FitResult:
        """Execute the stages on the whole volume."""
        self._execute("whole")
        return self.result

    def _execute(self, where: str) -> None:
        carry_out = {"signal": self._signal, "noise": self._noise, "candidates": self._candidates}
        carry_out |= {"finalists": self._finalists, "weights": self._weights}
        task = self.tasks.get(where)
        for stage in self.stages:
            if task is None or stage.where != where:
                continue
            before = self._done
            carry_out[stage.kind](stage, task)
            # projections of a whole volume need much memory; under outliers, the first one shows no vacuum
            rough = stage.kind == "signal" and stage.noise == "simple"
            if where == "slab" and self._vacuum is None and (rough or stage.kind == "weights"):
                clear, response = vacuum_pixels(task, self.least_vacuum), task.signal_model.image_formation
                if clear is not None and isinstance(response, Transmission | Linear):
                    units = response.vacuum_ratios.expand_as(clear)
                    self._vacuum = clear, units, (task.observation[clear], units[clear])
            if stage.remember:
                self._remembered = copy.deepcopy(task.signal_model.state_dict())
            # if a stage needed more or fewer fits than expected, correct the total, not the count
            self._expected += self._done - before - stage.num_steps * stage.fits

    def _level(self, noise_model: nn.Module) -> float | None:
        """The signal without an object, at a beam of 1, that pixels of vacuum say under a noise model; None if they do not."""
        lowest = -math.inf if self.least_signal is None else self.least_signal(noise_model)
        return None if self._vacuum is None else vacuum_level(noise_model, *self._vacuum[-1], lowest)

    def _signal(self, stage: FitStage, task: Task) -> None:
        task.forget(self.models[stage.noise])  # signals have moved since an earlier stage
        with ExitStack() as stack:
            # a blur is in pixels of the full resolution
            for _ in range(0 if task.signal_model.image_formation.blur else stage.halvings):
                task = stack.enter_context(task.halved())
            self.result = self._fit_signal(stage, task, stage.name)

    def _noise(self, stage: FitStage, task: Task) -> None:
        if stage.noise == "even":  # rounded and clipped as the simple one is
            simple = self.models["simple"]
            even = simple.around(Gaussian()) if isinstance(simple, Digitised) else Gaussian()
            self.models["even"] = even.to(task.observation.device)
        model, kind = self.models[stage.noise], as_noise_model(self.models[stage.noise])
        if kind.learns:
            standardise = stage.standardise or kind.starts_anew
            weighted = stage.where == "slab" and self.weight_choice is not None
            before = task.pull(model) if weighted else None
            self._fit_noise(stage.name, model, task, task.signal(), stage.num_steps, standardise=standardise)
            if before is not None:
                # the volume that held-out pixels prefer stays the most likely one under the new noise
                factor = float(torch.dot(task.pull(model), before) / before.square().sum())
                for each in self.tasks.values():
                    each.signal_model.weight *= factor if 0 < factor < math.inf else 1

    def _candidates(self, stage: FitStage, task: Task) -> None:
        """Choose the simplest candidate that predicts held-out pixels nearly as well as the best.

        Candidates that cannot be tabulated are excluded: they have a narrow peak for every electron, an artefact of fitting noise
        without such peaks.
        """
        signal, tried, lowest = task.signal(), list[_TriedModel](), self.tasks["whole"].observation.min()
        *simpler, richest = (model.to(task.observation.device) for model in self.candidates(task, signal))
        if math.isfinite(as_noise_model(richest).low):
            # least squares is biased by the clipping, and a mixture would describe that: the offset of counts was 0.16 too high
            self.models["simple"] = copy.deepcopy(simpler[0])
            self._fit_noise(f"{stage.name} 0", self.models["simple"], task, signal, stage.num_steps, standardise=True)
            self._fit_signal(replace(stage, noise="simple"), task, f"{stage.name} under clipping")
            signal = task.signal()
        if self._vacuum is not None and (level := self._level(self.models["simple"])) is not None:
            clear, units, _ = self._vacuum
            signal = torch.where(clear, level * units, signal)  # least squares left it at 0.99 where it is 0.5
        if self.least_signal is not None:
            signal = signal.clamp(min=max(self.least_signal(model) for model in (*simpler, richest)))

        def judged(model: nn.Module) -> _TriedModel:
            self._fit_noise(f"{stage.name} {len(tried) + 1}", model, task, signal, stage.num_steps, standardise=True)
            scores = task.held_out_log_prob(model, signal)
            least = model(torch.maximum(lowest, signal.min())).log_prob(lowest)  # −∞ in any row would stop a fit
            possible = model is richest or (bool(least.isfinite()) and task.tabulates(model, signal))
            return _TriedModel(model, scores if possible else scores.fill_(-math.inf))

        tried.append(judged(richest))
        for place, model in enumerate(simpler):
            tried.insert(place, judged(model))
            if _simplest(tried, task) is tried[place]:
                break
        chosen = _simplest(tried, task)
        self.models["chosen"] = chosen.model
        self._simpler = [each.model for each in tried[: tried.index(chosen)] if bool(each.scores.isfinite().all())]
        task.forget(*(each.model for each in tried if each.model not in (chosen.model, *self._simpler)))

    def _finalists(self, stage: FitStage, task: Task) -> None:
        """Fit the volume with the chosen noise model and, from the same state, with every simpler one; choose again.

        A flexible noise model also describes errors of a rough signal: on a needle with 10 counts, noise with the shape of counts
        was 0.15 nats behind a mixture before, and 0.07 ahead after twenty steps.
        """
        model, richest = task.signal_model, self.models["chosen"]
        start = copy.deepcopy(model.state_dict()) if self._simpler else {}
        tried, fits = list[_TriedModel](), dict[nn.Module, tuple[FitResult, dict[str, Tensor]]]()
        for number, noise_model in enumerate([richest, *self._simpler], 1):
            if tried:
                model.load_state_dict(start)
            self.models["chosen"] = noise_model
            result = self._fit_signal(stage, task, stage.name if number == 1 else f"{stage.name} {number}")
            tried.append(_TriedModel(noise_model, task.held_out_log_prob(noise_model)))
            fits[noise_model] = result, copy.deepcopy(model.state_dict()) if self._simpler else {}
        chosen = _simplest([*tried[1:], tried[0]], task).model
        self.models["chosen"], (self.result, adapted) = chosen, fits[chosen]
        task.forget(*(each.model for each in tried if each.model is not chosen))
        if adapted:
            model.load_state_dict(adapted)

    def _weights(self, stage: FitStage, task: Task) -> None:
        """Compare weights by fits from the same state, so that they are independent of each other; keep the most likely state.

        The remembered state is that under simple noise: after more steps under other noise models, weights are too low.
        """
        model = task.signal_model
        task.forget(self.models[stage.noise])  # the table of the present signals serves all fits
        start = self._rough(model)
        self._choose_weight(stage, task, start, self.first_weight)
        for regulariser in self.regularisers:
            # another regulariser costs little where it predicts as well: smooth blobs reach 1.0 to 6.8 standard errors, and with
            # 40 counts gain 1.9 dB; of 33 other independent series and 16 of 64³, none exceeds 0.9, and 45 are negative. With
            # another seed vesicles reached 1.3 by chance, and lost 1.8 dB; all of six choices of other pixels were below 0.5
            with self._trying(stage, task, 1, None if self.facts.by_gaps else self._of_other_pixels):
                model.load_state_dict(start)
                model.regulariser = regulariser
                self._fit_signal(stage, task, f"{stage.name}, {regulariser!r}")
        self._try_blur(stage, task, start)
        self._try_bend(stage, task)
        for each in self.tasks.values():
            own = each.signal_model
            own.weight, own.regulariser = model.weight * own.field.relative_weight, model.regulariser

    def _choose_weight(
        self, stage: FitStage, task: Task, start: dict[str, Tensor], first: float, name: str = "", **limits: Any
    ) -> None:
        model, likeliest, lowest = task.signal_model, start, math.inf

        def held_out_nll(weight: float) -> float:
            nonlocal likeliest, lowest
            model.load_state_dict(start)
            model.weight = weight
            # fits keep their best state: under a high weight that is an early one, and says nothing of the weight
            nll = self._fit_signal(stage, task, f"{stage.name}{name} {weight:.4g}").last_nll
            if nll < lowest:
                lowest, likeliest = nll, copy.deepcopy(model.state_dict())
            return nll

        self.weight_choice = choose_weight(held_out_nll, first, **limits)
        model.load_state_dict(likeliest)
        model.weight = self.weight_choice.weight

    def _try_blur(self, stage: FitStage, task: Task, start: dict[str, Tensor]) -> None:
        """Model a blur of the detector if noise correlates between neighbours as blurred noise does, unless held-out pixels are
        predicted significantly worse at a weight of its own.

        Noise that arises before the detector is blurred as the image is: its correlation shows the width, 0.5 to 0.9 between
        neighbours, and below 0.1 without a blur. Held-out pixels hardly see it on a gyroid, which gains 2 dB. Weights are 2 to 9
        times lower with a blur; much lower ones seem as good, because neighbours of held-out pixels tell their noise.
        """
        model, noise_model = task.signal_model, self.models[stage.noise]
        blur = task.blur_of_noise(noise_model) if self.find_blur else 0.0
        if blur > _LEAST_BLUR:
            start |= {"image_formation.blur": torch.tensor(blur)}
            task.forget(noise_model)
            with self._trying(stage, task, -STANDARD_ERRORS):
                self._choose_weight(stage, task, start, model.weight / 2**2, f", blur {blur:.2g}", most=stage.fits)

    def _try_bend(self, stage: FitStage, task: Task) -> None:
        """Model a bent response if the images of most tilts show it, and held-out pixels are predicted significantly better.

        Images with a gamma curve, thick matter in dark field, and X-rays of many energies are bent. A volume absorbs most of a
        bend: it makes matter hollow. With a gamma of 0.8 a gyroid gains 1.4 dB, fibres with 1.5 gain 5 dB. Misfit of a
        thick needle in bright field looks like a bend, which costs 12 dB: it is as large again once modelled, a bend is not.
        """
        model, noise_model, found = task.signal_model, self.models[stage.noise], list[float]()
        straight, tried = copy.deepcopy(model.state_dict()), math.nan
        while (current := float(model.image_formation.bend)) != tried:  # type: ignore[arg-type]
            more, error, reach = task.bend(noise_model)
            found.append(abs(more))
            tried = current
            seen = error < _MOST_ERROR and abs(more) > STANDARD_ERRORS * error
            if seen and abs(current + more) > _LEAST_BEND:
                task.forget(noise_model)
                with self._trying(stage, task, 0 if current else STANDARD_ERRORS):
                    bent = {"bend": current + more, "reach": reach}
                    changed = {f"image_formation.{name}": torch.tensor(value) for name, value in bent.items()}
                    model.load_state_dict(self._rough(model) | changed)
                    self._fit_signal(stage, task, f"{stage.name}, bend {current + more:.2g}")
        if bool(model.image_formation.bend) and found[-1] > _MOST_LEFT * found[0]:
            task.forget(noise_model)
            model.load_state_dict(straight)

    def _rough(self, model: TomographySignal, state: dict[str, Tensor] | None = None) -> dict[str, Tensor]:
        """A copy of the remembered state, or of another one, with the current response."""
        response = {f"image_formation.{name}": value for name, value in model.image_formation.state_dict().items()}
        return copy.deepcopy((state or self._remembered) | response)

    @contextmanager
    def _trying(self, stage: FitStage, task: Task, errors: float, others: _Gains | None = None) -> Iterator[None]:
        """Keep what is fitted inside only if it predicts held-out pixels better by some standard `errors`, also with `others`."""
        model, noise_model = task.signal_model, self.models[stage.noise]
        usual, state = task.held_out_log_prob(noise_model), copy.deepcopy(model.state_dict())
        before = model.weight, model.regulariser, self.weight_choice
        yield
        gains, blocks = task.held_out_log_prob(noise_model) - usual, task.blocks()
        gain, error = mean_and_error(gains, blocks)
        if gain > errors * error and others is not None:
            more, apart = others(stage, task, before[1])
            gain, error = mean_and_error(torch.cat([gains, more]), torch.cat([blocks, apart + blocks.max() + 1]))
        if not gain > errors * error:
            model.load_state_dict(state)
            model.weight, model.regulariser, self.weight_choice = before

    def _of_other_pixels(self, stage: FitStage, task: Task, usual: Regulariser) -> tuple[Tensor, Tensor]:
        """What pixels that are held out from the start, in place of the others, gain by the present regulariser; their blocks."""
        model, noise_model, held_out = task.signal_model, self.models[stage.noise], task.held_out
        state, chosen, scores = copy.deepcopy(model.state_dict()), model.regulariser, list[Tensor]()
        task.held_out = held_out.roll(1, 0)  # other pixels of every tilt
        steps = sum(each.num_steps for each in self.stages if each is stage or each.remember)
        longer = replace(stage, num_steps=steps, rate=1.0)
        for model.regulariser in (usual, chosen):
            model.load_state_dict(self._rough(model, self._coarse))
            self._fit_signal(longer, task, f"{stage.name}, {model.regulariser!r}, other pixels")
            scores.append(task.held_out_log_prob(noise_model))
        blocks, task.held_out = task.blocks(), held_out
        model.load_state_dict(state)
        return scores[1] - scores[0], blocks

    def _fit_signal(self, stage: FitStage, task: Task, name: str) -> FitResult:
        """Fit volume and response with a fixed noise model."""
        noise_model, model = self.models[stage.noise], task.signal_model
        if self.least_signal is not None:
            model.hold_above(self.least_signal(noise_model))
        level, response = self._level(noise_model), model.image_formation
        if level is not None and isinstance(response, Transmission | Linear):
            response.set_vacuum(level)
            response.vacuum.requires_grad_(False)
        # without noise, a haze over a lower offset fits as well as vacuum, and absorbs misfit (real needle: up to 0.4 dB)
        hold = self.facts.quiet and isinstance(response, Linear)
        model.keep_slopes = True
        try:
            return self._run(
                name,
                noise_model,
                model,
                task,
                num_steps=stage.num_steps,
                train_noise=False,
                standardise=False,
                # without a regulariser, only an early stop keeps the noise out of the volume
                keep_last=stage.final and model.weight > 0,
                parameter_groups=model.parameter_groups(rate=stage.rate, hold_response=hold),
                warm_up=_WARM_UP if stage.warm_up else 0.0,
                tables=None if stage.noise == "even" else task.tables(noise_model),  # no other stage has this model
            )
        finally:
            model.release()

    def _fit_noise(
        self, name: str, model: nn.Module, task: Task, signal: Tensor, num_steps: int, *, standardise: bool
    ) -> FitResult:
        for each in self.tasks.values():
            each.forget(model)
        kind = as_noise_model(model)
        num_steps = min(num_steps, kind.most_joint_steps or num_steps)
        options = {"learning_rate": kind.joint_learning_rate, "num_steps": num_steps}
        # a signal model, because its scatter along the signal is the misfit of the volume
        return self._run(name, model, KnownSignal(signal), task, standardise=standardise, **options)

    def _run(self, name: str, noise_model: nn.Module, signal: nn.Module, task: Task, **options: Any) -> FitResult:
        begun = self._done

        def report(_: str, step: int, __: int, note: str) -> None:
            self._done = begun + step
            if self.progress is not None:
                self.progress("reconstructing", self._done, max(self._expected, self._done), f"{name}, {note}")

        options |= {"mask": task.use, "held_out": task.held_out, "generator": self.generator, "batch_size": BATCH}
        options |= {"digitise": False, "progress": report}
        result = self.run_fit(self.prefix + name, noise_model, signal, task.observation, **options)
        self._done = begun + options["num_steps"]
        return result


def _simplest(tried: Sequence[_TriedModel], task: Task) -> _TriedModel:
    """The simplest model that predicts held-out pixels nearly as well as the best, or not much and not significantly worse."""
    best, blocks = max(tried, key=lambda each: float(each.scores.mean())), task.blocks()
    for each in tried:
        excess, error = mean_and_error(best.scores - each.scores, blocks)
        if each is best or excess <= max(_TOLERATED, STANDARD_ERRORS * min(error, _TOLERATED)):
            return each
    return best


@dataclass(frozen=True)
class Settled:
    """The choices on a slab for all slices of a series.

    Attributes:
        simple: simple noise model of the first fits.
        even: the same with one width at all signals, if the plan has stages for it.
        weight_choice: the evidence for the weight, if it was chosen.
        response, scale: state of the image formation, and scale of the field.
        start: the initial coarse volume of every block.
        signal_model, fit_result: of the slab; None if they were dropped.
    """

    simple: nn.Module
    even: nn.Module | None
    noise_model: nn.Module
    regulariser: Regulariser
    weight: float
    weight_choice: WeightChoice | None
    response: dict[str, Tensor]
    scale: float
    facts: Facts
    start: Start
    signal_model: TomographySignal | None
    fit_result: FitResult

    @staticmethod
    def of(run: Runner, start: Start) -> Settled:
        """The choices of a run on slabs only."""
        model = run.tasks["whole"].signal_model
        model.let_go()  # frees memory for the blocks
        return Settled(
            simple=run.models["simple"],
            even=run.models.get("even"),
            noise_model=run.noise_model,
            regulariser=model.regulariser,
            weight=model.weight,
            weight_choice=run.weight_choice,
            response=copy.deepcopy(model.image_formation.state_dict()),
            scale=float(model.field.scale),
            facts=run.facts,
            start=start,
            signal_model=model,
            fit_result=run.result,
        )
