"""Fitting a noise model on known signals, or jointly with a model of the signal."""

import logging
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from noiseflow.arguments import as_mask, as_weights, check, check_order, check_shapes, real, require_finite
from noiseflow.arrays import HALF, floating, is_array, unmasked
from noiseflow.distributions.noise_distribution import NoiseDistribution
from noiseflow.fitting.direct import fit_directly
from noiseflow.fitting.loop import Checkpoint, FitLoop, FitResult, LoopSettings
from noiseflow.fitting.observation_table import TableKeeper
from noiseflow.fitting.pixel_split import FitPixels
from noiseflow.fitting.signal_models import KnownSignal, StaticScene, check_signal_model, choosing_weight, predicted
from noiseflow.fitting.stages import StagedLoop, Student, forgets_errors
from noiseflow.fitting.stream import bounded
from noiseflow.models.at_level import above, at_level, level_of, without_level
from noiseflow.models.base import NoiseModelBase
from noiseflow.models.baselines import Gaussian
from noiseflow.models.conditioned import Conditioned, fit_by_condition, flat_conditions
from noiseflow.models.digitisation import Digitisation, detect_digitisation
from noiseflow.models.digitised import Digitised
from noiseflow.models.standardisation import Standardisation
from noiseflow.models.stuck_pixels import stuck_at, with_stuck_pixels
from noiseflow.models.wrapper import ForeignModel, as_noise_model
from noiseflow.progress import Progress
from noiseflow.resources import few_threads, num_threads, warn_if_spinning

_log = logging.getLogger("noiseflow")


@choosing_weight
@torch.inference_mode(False)
@torch.enable_grad()
def fit(
    noise_model: nn.Module,
    signal: Tensor | NDArray[Any] | nn.Module,
    observation: Tensor | NDArray[Any],
    *,
    condition: Mapping[str, Any] | None = None,
    mask: Tensor | NDArray[np.bool_] | None = None,
    weights: Tensor | NDArray[Any] | str | None = None,
    skip_non_finite: bool = False,
    digitise: bool = True,
    held_out: float | Tensor | NDArray[np.bool_] = 0.1,
    num_steps: int | None = None,
    batch_size: int = 8192,
    learning_rate: float | None = None,
    warm_up: float = 0.0,
    noise_interval: int = 10,
    noise_steps: int = 10,
    standardise: bool = True,
    train_noise: bool = True,
    tabulate: bool = True,
    keep_last: bool = False,
    generator: torch.Generator | None = None,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
    checkpoint_interval: float | None = None,
    resume: dict[str, Any] | None = None,
    parameter_groups: Sequence[dict[str, Any]] | None = None,
    tables: TableKeeper | None = None,
) -> FitResult:
    """Fit a noise model in place by maximum likelihood; with a trainable signal model, fit both jointly.

    The loss is the mean negative log-likelihood of the training pixels, plus the ``penalty()`` of the signal model if it has one.
    Learning rates decrease geometrically to 1 %. In a joint fit they decrease more slowly at first and reach zero at the end.

    A joint fit takes half of its steps under noise of Student's t, in which outliers count little, and then fits the noise model
    to the residuals, again after three quarters: from a rough signal, it would take errors of the signal for outliers. These
    residuals are first made as wide as those of the held-out pixels, because a signal follows the pixels it is fitted to. A noise
    model that is not trained is used as it is, in all steps, or in the second half if errors of the signal look like outliers to
    it. Both models are fitted together if `warm_up` or ``standardise=False`` says that the signal is a good one.

    Args:
        noise_model: the model to fit, a `NoiseModelBase` or any module that returns a distribution for signals. A model
            without trainable parameters is not changed.
        signal: clean signals, a tensor or array shaped like `observation`, or a `SignalModel`. Of more than ten million known
            pixels, a random sample is used, unless the noise model needs images. A trainable signal model may define
            ``parameter_groups()``, parameter groups with learning rates for Adam.
        observation: noisy images, a tensor or array of any shape and real type, detector units; images (..., y, x) if the
            noise model depends on neighbouring pixels.
        condition: what the noise depends on beyond the signal, such as ``{"gain": …}``: numbers, or arrays that broadcast with
            the observation, by name. The result holds a `Conditioned` model. Only for known signals and models of single pixels.
        mask: pixels to use, shaped like `observation`; all by default. Masked values of masked arrays are always excluded.
        weights: how much each pixel counts, shaped like `observation`, at least 0; all count alike by default. Pixels of weight 0
            are not used; others count as pixels repeated. Only for known signals, and not for offsets that lines share. Or
            ``"held-out"``: choose the weight of the signal model's ``penalty()`` by the likelihood of the held-out pixels, with
            about six fits; ``result.weight_choice`` holds it.
        skip_non_finite: exclude NaN and infinite pixels instead of raising an error.
        digitise: detect rounding and clipping (`detect_digitisation`) and, if found, wrap a model that does not describe them
            in `Digitised`; with a known signal, also values at which pixels are stuck (`StuckPixels`). The result holds the
            wrapped model; a log message reports it.
        held_out: fraction of the pixels to hold out for validation, or a boolean mask of these pixels.
        num_steps: optimisation steps; by default at most ``num_steps`` of the noise model, or 500.
        batch_size: pixels per noise-model step.
        learning_rate: initial learning rate of the noise model, and of a signal model without ``parameter_groups()``; by
            default ``learning_rate`` of the noise model, or 0.01.
        warm_up: share of the steps of a joint fit over which learning rates increase to their full value. Adam's first steps
            all have the full length: this helps a rough starting point and harms a good one.
        noise_interval, noise_steps: signal steps of a joint fit between steps of the noise model, and the number of those.
        standardise: first measure the scaling of the data and store it in the noise model, unless that is frozen.
        train_noise: whether to train the noise model; otherwise it is not changed.
        tabulate: in a joint fit of many pixels, look the likelihood up in a table.
        keep_last: return the last state of a joint fit, unless an earlier one predicts the held-out pixels better by three
            standard errors, instead of the best one; for a signal model that its penalty keeps from overfitting.
        progress: called with a task, completed and expected steps, and a note.
        checkpoint: called with a state for `resume` at every evaluation of the held-out pixels, and on Ctrl-C; never by fits to
            known signals that need no batches, which are short.
        checkpoint_interval: call `checkpoint` after a step at this interval (s) instead.
        resume: a state passed to `checkpoint`; the fit continues from it.
        parameter_groups: parameter groups of the signal model with learning rates, instead of its ``parameter_groups()``.
        tables: stores the tabulated likelihood for further fits of the same pixels under the same frozen noise model.

    Returns:
        The fitted model, the held-out likelihood and its history. Both models are left in their best held-out state.

    Raises:
        ValueError: an argument is out of range, shapes or devices differ, pixels are complex, not finite, or too few, their
            precision does not resolve the noise, signal and observation seem exchanged, the signal model returns shapes that
            `SignalModel` does not allow, or the likelihood is never finite.

    Example:
        >>> import noiseflow, torch
        >>> signal = torch.linspace(10.0, 100.0, 10_000)
        >>> observation = signal + 3 * torch.randn(10_000, generator=torch.Generator().manual_seed(0))
        >>> result = noiseflow.fit(noiseflow.Gaussian(), signal, observation, generator=torch.Generator().manual_seed(1))
        >>> round(result.noise_model.log_scale.exp().item(), 1)
        3.0
    """
    check(held_out=held_out, num_steps=num_steps, batch_size=batch_size, learning_rate=learning_rate, warm_up=warm_up)
    check(noise_interval=noise_interval, noise_steps=noise_steps, checkpoint_interval=checkpoint_interval)
    if condition is None:
        found = bounded(noise_model, signal, observation, mask, weights, held_out)
        signal, observation, mask, weights, held_out = found
    anew = standardise and train_noise
    data = _prepare(noise_model, signal, observation, mask, weights, held_out, skip_non_finite, digitise, anew)
    model, signal_model = data.model, data.signal_model
    cold, standardise = standardise and not warm_up, anew and model.learns
    result = FitResult(model.module if isinstance(model, ForeignModel) else model, data.digitisation)
    if condition is not None:
        options: dict[str, Any] = {"batch_size": batch_size, "num_steps": num_steps, "learning_rate": learning_rate}
        options |= {"generator": generator, "progress": progress}
        return data.raised(_fit_by_condition(data, condition, held_out, result, options))
    generator = torch.Generator().manual_seed(0) if generator is None else generator
    if not isinstance(generator, torch.Generator):
        raise TypeError(f"generator is {generator!r}; give torch.Generator().manual_seed(...)")
    # a random stream of its own, so that the choice of pixels is independent of data sampled with the same seed
    pixels = data.pixels(torch.Generator().manual_seed(int(torch.randint(2**62, (), generator=generator))))
    given, settled = num_steps, model.starts_most_likely and standardise and isinstance(signal_model, KnownSignal)
    num_steps = (0 if settled else model.num_steps) if num_steps is None else num_steps
    # whether the caller keeps checkpoints must not change the result; a direct fit takes no longer than a few steps of others
    direct = isinstance(signal_model, KnownSignal) and model.learns and model.fits_directly and not model.needs_image
    if direct and train_noise and resume is None and pixels.train.ndim == 1:
        options = {"num_steps": num_steps, "patience": given, "standardise": standardise, "progress": progress}
        return data.raised(_fit_directly(data, pixels, result, weight=data.weight, **options))
    pixels = pixels if data.weight is None else pixels.repeated(data.weight)
    loop = FitLoop(model, signal_model, pixels, result, tables)
    cold = cold and data.learns_signal and num_steps > 0 and not isinstance(signal_model, StaticScene)  # starts as mean
    cold = cold and (standardise or forgets_errors(loop)) if resume is None else resume["cold"]
    if cold and not isinstance(model, Gaussian):
        split = data.split(pixels) | {"batch_size": batch_size, "train_noise": train_noise}
        learn = partial(fit, model, observation=data.observation, **split)
        simple = replace(data, model=Student().to(data.observation.device), judge=split["held_out"])
        first = simple.model, signal_model, simple.pixels(pixels.generator), result
        loop = StagedLoop(learn, model, pixels, num_steps, *first)
    loop.prepare(
        model.learning_rate if learning_rate is None else learning_rate,
        standardise=(standardise or cold) and resume is None,
        train_noise=train_noise,
        parameter_groups=parameter_groups,
    )
    loop.widens = cold
    if resume is not None:
        loop.load_state(resume)
    if data.learns_signal:
        warn_if_spinning()
    settings = LoopSettings(
        num_steps, batch_size, warm_up, noise_interval, noise_steps, tabulate, keep_last, checkpoint_interval
    )
    with nullcontext() if data.learns_signal else few_threads(batch_size):
        return data.raised(loop.run(settings, progress, checkpoint))


@dataclass(frozen=True)
class _Data:
    model: NoiseModelBase
    signal_model: nn.Module
    observation: Tensor  # of any shape
    use: Tensor  # (N,)
    judge: float | Tensor  # share or mask of the held-out pixels
    weight: Tensor | None  # (N,)
    digitisation: Digitisation  # that the model was wrapped in
    level: float  # that was subtracted from the pixels

    @property
    def learns_signal(self) -> bool:
        return any(parameter.requires_grad for parameter in self.signal_model.parameters())

    def pixels(self, generator: torch.Generator) -> FitPixels:
        model, observation = self.model, self.observation
        if model.needs_image and observation.ndim < 2:
            kind, shape = type(model).__name__, tuple(observation.shape)
            raise ValueError(f"{kind} depends on neighbouring pixels: give images (..., y, x), not pixels {shape}")
        if self.weight is not None and (self.learns_signal or model.shared_axis is not None):
            raise ValueError("weights need a known signal and no shared offsets; leave pixels out with a mask")
        pixels = floating(observation), self.use, self.judge, generator
        axis = model.shared_axis
        return FitPixels.choose(*pixels) if axis is None else FitPixels.choose_lines(*pixels, axis=axis)

    def raised(self, result: FitResult) -> FitResult:
        """The result for pixel values with the level."""
        if self.level:
            result.noise_model = at_level(as_noise_model(result.noise_model), self.level)
            result.digitisation = result.digitisation.raised(self.level)
        return result

    def split(self, pixels: FitPixels) -> dict[str, Any]:
        """Arguments of another fit of the same pixels."""
        judged = torch.zeros(pixels.shape, dtype=torch.bool, device=pixels.judge.device)
        judged.view(-1)[pixels.judge] = True
        mask = self.use.view(pixels.shape)
        return {"mask": mask, "held_out": judged, "digitise": False}


def _prepare(
    noise_model: nn.Module,
    signal: Any,
    observation: Any,
    mask: Any,
    weights: Any,
    held_out: Any,
    skip_non_finite: bool,
    digitise: bool,
    anew: bool,
) -> _Data:
    """Check models and pixels, arguments as for `fit`; wrap the noise model in detected rounding and clipping, and if it is
    fitted `anew`, subtract a level above which single precision resolves the noise."""
    model = as_noise_model(noise_model)
    if any(each.requires_grad and each.dtype in HALF for each in model.parameters()):
        raise ValueError("parameters in half precision round a fit's steps away; fit model.float(), then convert it")
    (signal, observation), kept = unmasked(signal, observation)
    if is_array(signal) or isinstance(signal, Tensor):
        signal = real(signal, "signal")
    observation = real(observation, "observation")
    if not isinstance(signal, Tensor | nn.Module):
        kind = type(signal).__name__
        raise TypeError(f"signal is {kind}; give a tensor, an array (see noiseflow.sample_pixels) or a torch module")
    held = [signal, observation, *model.parameters(), *model.buffers()]
    places = {str(each.device) for each in held if isinstance(each, Tensor)}
    if len(places) > 1:
        raise ValueError(f"pixels and noise model are on {' and '.join(sorted(places))}; move them with .to(device)")
    use = as_mask(mask, observation)
    weight = None if weights is None else as_weights(weights, observation)
    use = use if weight is None else use & (weight > 0)
    judge = float(held_out) if np.ndim(held_out) == 0 else as_mask(held_out, observation, "held_out")
    if isinstance(signal, Tensor):
        check_shapes(signal=signal, observation=observation)
    signal_model: nn.Module = KnownSignal(signal) if isinstance(signal, Tensor) else signal
    check_signal_model(signal_model, observation.numel())
    use = use if kept is None else use & kept.to(use.device)
    finite = torch.isfinite(observation.reshape(-1))
    if isinstance(signal_model, KnownSignal):
        finite &= torch.isfinite(signal_model.flat)
    if not skip_non_finite:
        require_finite(finite[use], "a mask or skip_non_finite")
    use = use & finite
    digitisation, level = Digitisation(), 0.0
    if isinstance(signal_model, KnownSignal):
        whole = signal if isinstance(signal, Tensor) else signal_model.flat
        known, seen = whole.reshape(-1)[use], observation.reshape(-1)[use]
        level = level_of(known, seen, [model]) if anew and model.learns else 0.0
        if level:
            _log.warning("the model is fitted above %g, and noise_model of the result includes that in AtLevel", level)
            model, signal_model = without_level(model), KnownSignal(*above(level, whole))
            observation, known, seen = above(level, observation, known, seen)
        if isinstance(signal, Tensor):  # models are not exchanged with observations
            check_order(known, seen)
    model = model.model if isinstance(model, Conditioned) else model
    for part in model.modules():
        if isinstance(part, Standardisation):
            part.smooths = isinstance(signal, Tensor)
    if digitise and model.learns and not model.describes_single_readings:
        model, digitisation = _behind_converter(model, signal_model, observation, use)
        if isinstance(signal_model, KnownSignal):
            model = with_stuck_pixels({"": model}, known, stuck_at(known, seen, digitisation), digitisation)[""]
    return _Data(model, signal_model, observation, use, judge, weight, digitisation, level)


def _fit_by_condition(
    data: _Data, condition: Mapping[str, Any], held_out: Any, result: FitResult, options: dict[str, Any]
) -> FitResult:
    known, use = data.signal_model, data.use
    if data.model.needs_image or not isinstance(known, KnownSignal) or np.ndim(held_out):
        raise ValueError("conditions need a known signal, a model of single pixels, and a fraction held_out")
    given = {name: each[use] for name, each in flat_conditions(condition, data.observation).items()}
    weight = None if data.weight is None else data.weight[use]
    options |= {"digitise": False, "held_out": held_out}
    pixels = known.flat[use], data.observation.reshape(-1)[use]
    return fit_by_condition(fit, data.model, *pixels, given, weight, result, options)


def _fit_directly(data: _Data, pixels: FitPixels, result: FitResult, **options: Any) -> FitResult:
    """Fit the noise model to a known signal by its own method; again if the fit has moved the levels of the converter."""
    model, signal = data.model, predicted(data.signal_model, pixels.observation)
    counted = (pixels if data.weight is None else pixels.repeated(data.weight)).train
    with num_threads(1):  # a fit has a few thousand cells
        fit_directly(model, signal, pixels, result, **options)
        if model.match_levels(signal[counted], pixels.observation[counted]):
            # the edges move little, and so does the model
            options |= {"standardise": False, "num_steps": result.num_steps + max(1, options["num_steps"] // 2)}
            fit_directly(model, signal, pixels, result, **options)
        return result


def _behind_converter(
    noise_model: NoiseModelBase, signal_model: nn.Module, observation: Tensor, use: Tensor
) -> tuple[NoiseModelBase, Digitisation]:
    """Wrap the model in `Digitised` if the pixel values are rounded or clipped; return it with the detected digitisation."""
    found = detect_digitisation(observation, predicted(signal_model, observation), use=use.reshape(observation.shape))
    # distributions of other libraries have no probabilities of intervals
    one = torch.zeros(1, device=observation.device)
    if not found.found or not (noise_model.needs_image or isinstance(noise_model(one), NoiseDistribution)):
        return noise_model, Digitisation()
    _log.warning(
        "pixel values are %s: the model is wrapped in Digitised, and noise_model of the result includes it "
        "(disable with digitise=False)",
        found.in_words(),
    )
    return noise_model.behind(lambda inner: Digitised(inner, *found)), found
