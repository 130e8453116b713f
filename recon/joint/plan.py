"""What a joint fit will do: a list of stages, made from what is known of the series and what the user settled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from noiseflow.described import described

Kind = Literal["signal", "noise", "candidates", "finalists", "weights"]
Where = Literal["slab", "whole"]
Noise = Literal["simple", "chosen"]


@dataclass(frozen=True)
class Facts:
    """What is known of a series before any fit.

    Attributes:
        choose_noise: whether the noise model is chosen among candidates.
        learn_noise: whether the noise model that the volume ends with has anything to learn.
        simple_is_final: whether that model is the simple one that every fit begins with (least squares).
        choose_weight: whether the weight of the regulariser is chosen.
        halvings: how often the resolution can be halved where that is worth it. Where it can be twice, long wavelengths need
            more steps than others, and cost little: a block of 512³ shells under true noise has 19.68 dB after two times 74
            steps at half the resolution, 19.98 with 300 at a quarter in place of the first 74 and 148 at half, and 20.19 with 300
            at half, which take 15 % more time; a slab that fills the field then loses 0.12 dB.
        settled: whether noise model, weight and response are known from other slices of the same series.
        quiet: whether noise is small beside the contrast, and the noise model learns: most of what a fit leaves is then misfit,
            which a width that follows the signal would excuse where it is bright. Where the noise model is not given, the volume
            is fitted by least squares, weights are judged by gaps of tilts, for pixels share the misfit of their neighbours, and
            the noise model describes what is left; one that is given takes over at three quarters of the steps.
        hold_offset: whether the offset of a linear response stays as the coarse reconstruction found it: without noise, a haze
            over a lower offset looks as good as vacuum to least squares, and absorbs misfit.
    """

    choose_noise: bool = True
    learn_noise: bool = True
    simple_is_final: bool = False
    choose_weight: bool = True
    halvings: int = 0
    settled: bool = False
    quiet: bool = False
    hold_offset: bool = False


@dataclass(frozen=True)
class Schedule:
    """Numbers of steps and learning rates; `docs/benchmarks/ablations.md` has a row for each.

    Attributes:
        settle: signal steps on the slab before noise models are compared.
        candidate: steps of each candidate noise model; its likelihood then differs from where it would end by less than the
            tolerance of the choice.
        adapt: signal steps on the slab under the chosen noise model, and under the likeliest simpler one.
        refine: noise-model steps on the slab, on a signal that has become better; more would describe the slab's misfit.
        learn: noise-model steps on the whole volume of a quiet series.
        describe: the same where nothing follows them: misfit spans three decades, and after 60 steps a needle's noise model
            was still ten times too wide.
        trial: signal steps that compare weights, after the first quarter of those of the volume.
        quiet_trial: the same where noise is small, as many as finish the volume: unfinished fits predict gaps of tilts best at
            far too large a weight (needle: 51 after 50 steps, 8 after 180).
        whole: signal steps of the volume, unless the user gives their number.
        quiet: the same where noise is small: there is more to fit.
        rate: learning rate of all signal fits but the first; 1.4 times as much diverges on sparse objects of 96 voxels.
    """

    settle: int = 40
    candidate: int = 30
    adapt: int = 20
    refine: int = 20
    learn: int = 60
    describe: int = 600
    trial: int = 50
    quiet_trial: int = 180
    whole: int = 150
    quiet: int = 240
    rate: float = 0.6


@described(rate="of a rough start's learning rate")
@dataclass(frozen=True)
class FitStage:
    """One stage of a joint fit.

    Attributes:
        name: unique within a plan; the journal keeps what the stage reached under it.
        kind: ``signal`` fits the volume and response under a fixed noise model; ``noise`` fits the noise model to a fixed signal;
            ``candidates`` fits several noise models to a fixed signal and takes one; ``finalists`` fits the volume under that
            one and under the likeliest simpler one, and takes one of the two; ``weights`` compares weights of the regulariser.
        where: the slab that choices are made on, or the whole volume.
        noise: the simple noise model that every fit begins with, or the model of choice.
        num_steps: optimisation steps; of each fit, where there are several.
        rate: learning rate of the signal, relative to a rough start's.
        halvings: how often the resolution is halved.
        afresh: start from the coarse reconstruction again.
        warm_up: the rate grows to its full size first: the first steps of Adam are as large where little is left.
        hold_offset: leave the offset as it is.
        standardise: measure the noise model's scaling first.
        fits: how many fits the stage is expected to make.
    """

    name: str
    kind: Kind
    where: Where
    noise: Noise
    num_steps: int
    rate: float = 1.0
    halvings: int = 0
    afresh: bool = False
    warm_up: bool = False
    hold_offset: bool = False
    standardise: bool = False
    fits: int = 1


_START = (
    10  # steps of a noise model that is measured rather than fitted: of one parameter, or one width at every signal
)
_TRIALS, _CANDIDATES = 4, 2  # fits that these stages usually make, for the progress bar


def plan(facts: Facts, *, num_steps: int | None = None, schedule: Schedule | None = None) -> list[FitStage]:
    """The stages of a joint fit.

    Args:
        facts: what is known of the series.
        num_steps: signal steps of the whole volume; by default as the schedule says.
        schedule: numbers of steps and learning rates.
    """
    schedule = Schedule() if schedule is None else schedule
    choosing = not facts.settled and (facts.choose_noise or facts.choose_weight or facts.learn_noise)
    stages = _on_the_slab(facts, schedule) if choosing else []
    if not facts.settled and not (choosing and (facts.quiet or facts.simple_is_final)):
        # the slab of most contrast leaves more than the volume does: +0.1 dB in the mean of twelve scenes of 96³, up to +0.7
        stages.append(FitStage("start noise of the volume", "noise", "whole", "simple", _START, standardise=True))
    usual = schedule.quiet if facts.quiet else schedule.whole
    halvings = facts.halvings if num_steps is None else min(1, facts.halvings)
    stages += _on_the_whole(replace(facts, halvings=halvings), schedule, usual if num_steps is None else num_steps)
    if facts.quiet and facts.simple_is_final and not facts.settled:
        stages.append(FitStage("describe noise", "noise", "whole", "chosen", schedule.describe, standardise=True))
    return stages


def _on_the_slab(facts: Facts, schedule: Schedule) -> list[FitStage]:
    noise: Noise = "simple" if facts.simple_is_final else "chosen"
    hold = facts.hold_offset
    stages = [
        FitStage("start noise", "noise", "slab", "simple", _START, standardise=True),
        FitStage("settle", "signal", "slab", "simple", schedule.settle, hold_offset=hold),
    ]
    if (
        facts.quiet and not facts.simple_is_final
    ):  # a width measured on a rough signal leaves the volume to the regulariser
        stages.append(FitStage("measure noise", "noise", "slab", "simple", _START, standardise=True))
    if facts.choose_noise:
        stages.append(FitStage("choose noise", "candidates", "slab", "chosen", schedule.candidate, fits=_CANDIDATES))
    elif facts.learn_noise:
        stages.append(FitStage("learn noise", "noise", "slab", noise, schedule.refine, standardise=True))
    adapt: Kind = "finalists" if facts.choose_noise else "signal"
    stages.append(
        FitStage("adapt", adapt, "slab", noise, schedule.adapt, rate=schedule.rate, warm_up=True, hold_offset=hold)
    )
    if facts.learn_noise:
        stages.append(FitStage("refine noise", "noise", "slab", noise, schedule.refine))
    if facts.choose_weight:
        # trial and final fits share one schedule, because longer fits favour larger weights
        rate, begin, steps = schedule.rate, schedule.whole // 4, schedule.trial
        if facts.quiet:
            begin, steps = schedule.quiet // 4, schedule.quiet_trial
        again = FitStage("begin again", "signal", "slab", "simple", begin, rate=rate, afresh=True, hold_offset=hold)
        trials = FitStage("choose weight", "weights", "slab", noise, steps, rate=rate, hold_offset=hold, fits=_TRIALS)
        stages += [again, trials]
        if facts.learn_noise:
            stages.append(FitStage("refine noise at the weight", "noise", "slab", noise, schedule.refine))
    return stages


def _on_the_whole(facts: Facts, schedule: Schedule, num_steps: int) -> list[FitStage]:
    """From the coarse reconstruction again, under what is chosen: steps under other noise or another weight leave traces."""
    noise: Noise = "simple" if facts.simple_is_final else "chosen"
    quarter, stages = num_steps // 4, list[FitStage]()
    taken_over = facts.quiet and not facts.simple_is_final

    def add(name: str, model: Noise, steps: int, halvings: int = 0) -> None:
        rate, hold = schedule.rate, facts.hold_offset
        stages.append(FitStage(name, "signal", "whole", model, steps, rate=rate, halvings=halvings, hold_offset=hold))

    if quarter:  # the simple noise pulls at a rough signal steadily
        begin = 2 * quarter if facts.halvings == 2 else quarter
        add("begin", "simple", begin, min(1, facts.halvings) if taken_over else facts.halvings)
        if taken_over:
            add("go on", "simple", 2 * quarter)
            if not facts.settled:  # blocks of one volume share the noise model that the slab has taught
                name = "learn noise on the volume"
                stages.append(FitStage(name, "noise", "whole", noise, schedule.learn, standardise=True))
        elif facts.halvings == 2:
            add("go on", noise, 6 * quarter, 2)
            add("go on at half", noise, 4 * quarter, 1)
        elif facts.halvings:
            add("go on", noise, quarter, 1)
    add("fit", noise, num_steps - quarter * (3 if taken_over else 2 if facts.halvings else 1))
    return stages


def total_steps(stages: Sequence[FitStage]) -> int:
    """Steps of all fits that a plan expects."""
    return sum(stage.num_steps * stage.fits for stage in stages)


def describe(stages: Sequence[FitStage]) -> str:
    """A plan as lines of text: where, name, kind, steps, and how."""
    lines = []
    for stage in stages:
        steps = f"{stage.num_steps} x {stage.fits}" if stage.fits > 1 else f"{stage.num_steps}"
        how: list[str] = [stage.noise]
        if stage.kind in ("signal", "finalists", "weights"):
            how.append(f"rate {stage.rate:g}")
        if stage.hold_offset:
            how.append("offset held")
        if stage.afresh:
            how.append("afresh")
        if stage.warm_up:
            how.append("warm-up")
        if stage.halvings:
            how.append(("half the resolution", "a quarter of the resolution")[stage.halvings - 1])
        lines.append(f"{stage.where:<5}  {stage.name:<27}  {stage.kind:<10}  {steps}  {', '.join(how)}")
    return "\n".join(lines)
