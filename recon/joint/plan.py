"""The plan of a joint fit: a list of stages, from properties of the series and settings of the user."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from noiseflow.described import described

Kind = Literal["signal", "noise", "candidates", "finalists", "weights", "fields"]
Where = Literal["slab", "whole"]
Noise = Literal["even", "simple", "chosen"]


@dataclass(frozen=True)
class Facts:
    """Properties of a series that are known before any fit.

    Attributes:
        learn_noise: whether the final noise model of the volume has trainable parameters.
        simple_is_final: whether that model is the simple one of the first fits (least squares).
        halvings: how often the resolution can usefully be halved. If twice, long wavelengths get more steps, which are cheap: a
            block of 512³ shells gains 0.3 dB.
        settled: whether noise model, weight and response are known from other slices of the same series.
        quiet: whether noise is small compared with the contrast. The residuals are then mostly misfit, which a signal-dependent
            width would absorb at bright pixels, and which the true noise would forbid at dark ones. The volume is fitted by least
            squares, so `simple_is_final`, and a noise model that is not frozen to the residuals.
        by_gaps: whether noise is small, so that weights are chosen by gaps of tilts, because misfit correlates between
            neighbouring pixels (needle of 64², least squares: 7.41 in place of 7.61 nats per pixel).
        clipped: whether the simple noise model includes clipping. Its width follows the signal, and dark pixels that a rough
            volume misses would get the width of that misfit: the fit then keeps it (particles in 8 bits of 48³: 22.9 for 30.9
            dB). The first half of the steps has one width for all signals.
    """

    choose_noise: bool = True
    learn_noise: bool = True
    simple_is_final: bool = False
    choose_weight: bool = True
    halvings: int = 0
    settled: bool = False
    quiet: bool = False
    by_gaps: bool = False
    clipped: bool = False


@dataclass(frozen=True)
class Schedule:
    """Numbers of steps and learning rates; `docs/benchmarks/schedule.md` has a row for each.

    Attributes:
        settle: signal steps on the slab before noise models are compared.
        adapt: steps of each candidate noise model; signal steps on the slab under the chosen one and every simpler one (after 15,
            counts of a core-shell object were given read noise: -0.5 dB, and 5 % of the mass); and noise-model steps after the
            signal has improved, of which more would fit the misfit of the slab.
        describe: noise-model steps on the whole volume of a quiet series; after 60, the noise of a needle was still ten times too
            wide.
        trial: signal steps for the comparison of weights, after those of `settle`. Three quarters of `quiet` for quiet series,
            because unconverged fits predict gaps of tilts best at much too large weights (needle: 51 after 50 steps, 8 after
            180).
        whole: signal steps of the volume, unless the user sets their number.
        quiet: the same for quiet series, which have more detail to fit.
        rate: learning rate of all signal fits but the first; 1.4 times as much diverges on sparse objects of 96 voxels.
    """

    settle: int = 40
    adapt: int = 20
    describe: int = 600
    trial: int = 50
    whole: int = 100
    quiet: int = 160
    rate: float = 0.6


@described(rate="of a rough start's learning rate")
@dataclass(frozen=True)
class FitStage:
    """One stage of a joint fit.

    Attributes:
        name: unique name within a plan; the journal stores the result of the stage under it.
        kind: ``signal`` fits the volume and response with a fixed noise model; ``noise`` fits the noise model to a fixed signal;
            ``candidates`` fits several noise models to a fixed signal and chooses one; ``finalists`` fits the volume with that
            one and with every simpler one, and chooses again; ``weights`` compares regulariser weights;
            ``fields`` compares fields, see `recon.methods.joint`.
        noise: the simple noise model of the first fits, the same with an even width at all signals, or the chosen model.
        num_steps: optimisation steps of each fit.
        rate: learning rate of the signal relative to that for a rough start.
        halvings: how often the resolution is halved.
        remember: weights are compared from the volume after this stage on.
        warm_up: increase the rate gradually at the start, because the first steps of Adam have full length even near the optimum.
        standardise: measure the scaling of the noise model first.
        fits: expected number of fits of the stage.
        final: keep the last state. Stages that another one follows keep the best: with the last ones, the volume of shells was
            0.05 dB worse after half of the steps at half the resolution.
    """

    name: str
    kind: Kind
    where: Where
    noise: Noise
    num_steps: int
    rate: float = 1.0
    halvings: int = 0
    remember: bool = False
    warm_up: bool = False
    standardise: bool = False
    fits: int = 1
    final: bool = False


_START = 10  # steps of a noise model that standardisation determines: one parameter, or one width at every signal
_TRIALS, _CANDIDATES = 4, 2  # usual number of fits of these stages, for the progress bar


def plan(
    facts: Facts, *, num_steps: int | None = None, usual: int | None = None, schedule: Schedule | None = None
) -> list[FitStage]:
    """The stages of a joint fit.

    Args:
        facts: what is known of the series.
        num_steps: signal steps of the whole volume; by default the usual ones, with more at a quarter of the resolution.
        usual: usual steps of the field; by default those of the schedule.
        schedule: numbers of steps and learning rates.
    """
    schedule = Schedule() if schedule is None else schedule
    choosing = not facts.settled and (facts.choose_noise or facts.choose_weight or facts.learn_noise)
    stages = _on_the_slab(facts, schedule) if choosing else []
    if not facts.settled and not (choosing and facts.simple_is_final):
        # the slab with the highest contrast has larger residuals than the volume; this gains 0.1 dB in the mean of twelve
        # scenes of 96³, at most 0.7
        first: Noise = "even" if facts.clipped else "simple"
        stages.append(FitStage("start noise of the volume", "noise", "whole", first, _START, standardise=True))
    usual = usual or (schedule.quiet if facts.quiet else schedule.whole)
    halvings = facts.halvings if num_steps is None else min(1, facts.halvings)
    stages += _on_the_whole(replace(facts, halvings=halvings), schedule, usual if num_steps is None else num_steps)
    if facts.quiet and not facts.settled:
        stages.append(FitStage("describe noise", "noise", "whole", "chosen", schedule.describe, standardise=True))
    return stages


def _on_the_slab(facts: Facts, schedule: Schedule) -> list[FitStage]:
    noise: Noise = "simple" if facts.simple_is_final else "chosen"
    stages, settle, rate = list[FitStage](), schedule.settle, 1.0
    if facts.clipped:
        stages.append(FitStage("start with one width", "noise", "slab", "even", _START, standardise=True))
        stages.append(FitStage("settle with one width", "signal", "slab", "even", settle // 2))
        settle, rate = settle - settle // 2, schedule.rate
    stages.append(FitStage("start noise", "noise", "slab", "simple", _START, standardise=True))
    remember = facts.choose_weight
    stages.append(FitStage("settle", "signal", "slab", "simple", settle, rate=rate, remember=remember))
    if facts.choose_noise:
        stages.append(FitStage("choose noise", "candidates", "slab", "chosen", schedule.adapt, fits=_CANDIDATES))
    elif facts.learn_noise:
        stages.append(FitStage("learn noise", "noise", "slab", noise, schedule.adapt, standardise=True))
    adapt: Kind = "finalists" if facts.choose_noise else "signal"
    stages.append(FitStage("adapt", adapt, "slab", noise, schedule.adapt, rate=schedule.rate, warm_up=True))
    if facts.learn_noise:
        stages.append(FitStage("refine noise", "noise", "slab", noise, schedule.adapt))
    if facts.choose_weight:
        steps, rate = schedule.quiet * 3 // 4 if facts.by_gaps else schedule.trial, schedule.rate
        stages.append(FitStage("choose weight", "weights", "slab", noise, steps, rate=rate, fits=_TRIALS))
        if facts.learn_noise:
            stages.append(FitStage("refine noise at the weight", "noise", "slab", noise, schedule.adapt))
    return stages


def _on_the_whole(facts: Facts, schedule: Schedule, num_steps: int) -> list[FitStage]:
    """Stages on the whole volume. They restart from the coarse reconstruction, because steps with other noise models or weights
    affect the result."""
    noise: Noise = "simple" if facts.simple_is_final else "chosen"
    quarter, stages = num_steps // 4, list[FitStage]()

    def add(name: str, model: Noise, steps: int, halvings: int = 0, **how: bool) -> None:
        stages.append(FitStage(name, "signal", "whole", model, steps, rate=schedule.rate, halvings=halvings, **how))

    if quarter:  # the simple noise model converges steadily from a rough signal
        # one stage, as rates start again with every stage; half of the steps at half the resolution lost 0.12 dB in twelve scenes
        begin = 2 * quarter if facts.halvings == 2 else quarter
        if facts.clipped:
            add("begin with one width", "even", begin - begin // 2, facts.halvings)
            begin //= 2
            if begin and not facts.settled:
                stages.append(FitStage("noise of the volume", "noise", "whole", "simple", _START, standardise=True))
        if begin:
            add("begin", "simple", begin, facts.halvings)
        if facts.halvings == 2:
            add("go on", noise, 6 * quarter, 2)
            add("go on at half", noise, 4 * quarter, 1)
    add("fit", noise, num_steps - quarter * max(1, facts.halvings), final=True)
    return stages


def total_steps(stages: Sequence[FitStage]) -> int:
    """Expected number of steps of all fits of a plan."""
    return sum(stage.num_steps * stage.fits for stage in stages)


def describe(stages: Sequence[FitStage]) -> str:
    """A plan as lines of text: slab or whole, name, kind, steps and options."""
    lines = []
    for stage in stages:
        steps = f"{stage.num_steps} x {stage.fits}" if stage.fits > 1 else f"{stage.num_steps}"
        how: list[str] = [stage.noise]
        how += [f"rate {stage.rate:g}"] if stage.kind not in ("noise", "candidates") else []
        how += ["remembered"] * stage.remember + ["warm-up"] * stage.warm_up
        if stage.halvings:
            how.append(("half the resolution", "a quarter of the resolution")[stage.halvings - 1])
        lines.append(f"{stage.where:<5}  {stage.name:<27}  {stage.kind:<10}  {steps}  {', '.join(how)}")
    return "\n".join(lines)
