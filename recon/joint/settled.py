"""A plan with its runner, and the choices on a slab for all slices of a series."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

from torch import Tensor, nn

from noiseflow import FitResult
from noiseflow.fitting.result import WeightChoice
from recon.fields.regularisers.base import Regulariser
from recon.joint.coarse_start import Start
from recon.joint.plan import Facts, FitStage
from recon.joint.run import Runner
from recon.joint.signal_model import TomographySignal


@dataclass(frozen=True)
class Settled:
    """The choices on a slab for all slices of a series.

    Attributes:
        simple: simple noise model of the first fits.
        noise_model: the chosen noise model.
        regulariser: the regulariser.
        weight: its weight.
        weight_choice: the evidence for the weight, if it was chosen.
        response: state of the image formation.
        scale: scale of the field.
        facts: properties of the series.
        start: the initial coarse volume of every block.
        signal_model: fitted signal model of the slab; None if it was dropped.
        fit_result: result of its last fit.
    """

    simple: nn.Module
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

    def portable(self) -> Settled:
        """A copy without the projector matrices, which every worker computes itself."""
        return replace(self, signal_model=None)


class PlannedRun:
    """A plan with its runner: first the choices on the slab, then the volume."""

    def __init__(self, facts: Facts, stages: list[FitStage], runner: Runner) -> None:
        self.facts, self.stages, self.runner = facts, stages, runner
        self.weight_choice: WeightChoice | None = None

    @property
    def noise_model(self) -> nn.Module:
        """The chosen noise model."""
        simple = self.facts.simple_is_final and not self.facts.quiet
        return self.runner.models["simple" if simple else "chosen"]

    @property
    def likelihood(self) -> nn.Module:
        """The noise model of the final fit of the volume; the chosen one if no fit was needed."""
        last = [stage for stage in self.stages if stage.kind == "signal"][-1:]
        return self.runner.models[last[0].noise] if last else self.noise_model

    def choose(self) -> None:
        """Run the stages on the slab; the whole volume starts from the response found there."""
        self.runner.run([stage for stage in self.stages if stage.where == "slab"])
        self.weight_choice = self.runner.weight_choice
        slab, whole = (self.runner.tasks[where].signal_model for where in ("slab", "whole"))
        whole.image_formation.load_state_dict(copy.deepcopy(slab.image_formation.state_dict()))

    def fit_whole(self) -> FitResult:
        """Run the stages on the whole volume."""
        self.runner.run([stage for stage in self.stages if stage.where == "whole"])
        return self.runner.result

    def settled(self, start: Start) -> Settled:
        """The choices of a run on slabs only."""
        model = self.runner.tasks["whole"].signal_model
        model.let_go()  # frees memory for the blocks
        return Settled(
            simple=self.runner.models["simple"],
            noise_model=self.noise_model,
            regulariser=model.regulariser,
            weight=model.weight,
            weight_choice=self.weight_choice,
            response=copy.deepcopy(model.image_formation.state_dict()),
            scale=float(model.field.scale),
            facts=self.facts,
            start=start,
            signal_model=model,
            fit_result=self.runner.result,
        )
