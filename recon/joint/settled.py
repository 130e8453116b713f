"""The choices on a slab for all slices of a series."""

from __future__ import annotations

import copy
from dataclasses import dataclass

from torch import Tensor, nn

from noiseflow import FitResult
from noiseflow.fitting.result import WeightChoice
from recon.fields.regularisers.base import Regulariser
from recon.joint.coarse_start import Start
from recon.joint.plan import Facts
from recon.joint.run import Runner
from recon.joint.signal_model import TomographySignal


@dataclass(frozen=True)
class Settled:
    """The choices on a slab for all slices of a series.

    Attributes:
        simple: simple noise model of the first fits.
        even: the same with one width at all signals, if the plan has stages for it.
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
