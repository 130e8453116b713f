"""Observation and signal, pixel by pixel: what an exposure pair or a burst becomes before anything is fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.exposures.frames import ExposurePair, Image, rails
from calibration.exposures.masks import Mask, MaskCounts, clear_of_rails, defects, saturated
from calibration.exposures.scaling import Scaling, VarianceLine, fit_line, fit_scaling, own_variance, ring_mean
from calibration.registration.align import Registration, register
from noiseflow.described import described

LARGEST_SHARE = 0.5
"""Share of the residual's variance above which the 'long' exposure is the noisier of the two."""

LARGEST_RATIO_ERROR = 0.25
"""Departure, in the logarithm, of the exposures' scale from their ratio that a change of dose may explain."""

MINIMUM_PIXELS = 500
"""Pixels below which a noise model cannot be distinguished from another."""


@described(short="counts", long="as recorded", signal="counts")
@dataclass(frozen=True)
class AlignedPair:
    """A short exposure, untouched, and the signal of each of its pixels, from the registered long one.

    Attributes:
        short: (y, x) counts.
        long: (y, x) as recorded.
        signal: (y, x) the long exposure warped and scaled onto it, counts.
        mask: (y, x) pixels to trust.
        registration: how the long exposure was warped.
        scaling: how it was scaled.
        total_variance: of short − signal, as a line in the signal.
        signal_variance: the part of it that is the signal's own noise.
        counts: the pixels left out.
        exposure_ratio: as given; None if unknown.
        frames: of the burst whose mean is the signal; 1 for an exposure pair.

    Example:
        >>> import calibration, noiseflow, torch
        >>> camera = noiseflow.PoissonGaussian(gain=2.0, offset=100.0, read_noise=1.0)
        >>> signal = 100 + 2 * torch.linspace(20, 400, 64).expand(6, 64, 64)
        >>> frames = camera(signal).sample(generator=torch.Generator().manual_seed(0)).round()
        >>> pairs, _ = calibration.align_burst(calibration.Burst(frames))
        >>> pair = pairs[0]
        >>> pair.observation.shape, pair.frames, float(pair.mask.mean())
        ((64, 64), 6, 1.0)
    """

    short: Image
    long: Image
    signal: Image
    mask: Mask
    registration: Registration
    scaling: Scaling
    total_variance: VarianceLine
    signal_variance: VarianceLine
    counts: MaskCounts
    exposure_ratio: float | None = None
    frames: int = 1

    @property
    def observation(self) -> Image:
        """(y, x) the short exposure with its scatter about the signal shrunk to the short exposure's own."""
        return self.signal + np.sqrt(1 - self.share) * (self.short - self.signal)

    @property
    def one_setting(self) -> bool:
        """Whether one detector setting took both exposures: a ratio was given, and their scale agrees with it."""
        if self.exposure_ratio is None or self.scaling.slope <= 0:
            return False
        return bool(abs(np.log(self.scaling.slope * self.exposure_ratio)) < LARGEST_RATIO_ERROR)

    @property
    def share(self) -> Image:
        """(y, x) fraction of the residual's variance that is the signal's own noise."""
        return share_of(self.signal_variance, self.total_variance, self.signal)


def share_of(part: VarianceLine, total: VarianceLine, signal: Image) -> Image:
    """Ratio of two variance lines at each signal, within [0, 0.9]; 0.9 where the part is all there is, 0 where there is none."""
    own, whole = np.maximum(part(signal), 0.0), total(signal)
    return np.asarray(np.divide(own, whole, out=np.where(own > 0, 0.9, 0.0), where=whole > own).clip(max=0.9))


def align_pair(pair: ExposurePair) -> AlignedPair:
    """Register a pair, warp the long exposure onto the short one, and bring both to one scale.

    Raises:
        ValueError: the frames cannot be registered or scaled, too few pixels remain, the long exposure is the noisier
            one, or it is a copy of the short one.

    Example:
        >>> import calibration, noiseflow, pathlib
        >>> folder = pathlib.Path(noiseflow.__file__).parent / "data" / "exposures_miro"
        >>> pairs = calibration.read_pairs([folder / "channel1_050ms.tif"], [folder / "channel1_long.tif"])
        >>> aligned = calibration.align_pair(pairs[0])
        >>> aligned.registration.motion, bool(aligned.mask.mean() > 0.9)
        ('translation', True)
    """
    names = (pair.short_name, pair.long_name)
    return align_with(pair, register(_saturated_alike(pair.short, pair.long), pair.long, names=names))


def _saturated_alike(short: Image, long: Image) -> Image:
    """The short exposure cut off at the brightness at which the long one saturates: edges that only one shows would mislead."""
    share = float(np.mean(saturated(long)))
    return np.minimum(short, np.quantile(short, 1 - share)) if share else short


def align_with(pair: ExposurePair, registration: Registration) -> AlignedPair:
    """Warp and scale a pair whose transform is known already. Raises as `align_pair`.

    Example:
        >>> import calibration, numpy as np
        >>> from scipy.ndimage import gaussian_filter
        >>> scene = 1000 * gaussian_filter(np.random.default_rng(0).random((128, 128)), 2)
        >>> rng = np.random.default_rng(1)
        >>> pair = calibration.ExposurePair(rng.poisson(scene / 10), rng.poisson(20 * scene))
        >>> again = calibration.align_with(pair, calibration.align_pair(pair).registration)
        >>> round(again.scaling.slope * 200)
        1
    """
    long, covered = registration.warp(pair.long)
    hot, dead = defects(np.stack([pair.short, pair.long]))
    bad = (hot | dead | saturated(pair.long)).astype(float)
    reached, _ = registration.warp(bad)  # a bad pixel spoils all that its interpolation reaches
    trusted = covered & ~(hot | dead) & (np.abs(reached) < 0.01)
    _require_pixels(trusted, pair)
    level = ring_mean(long, trusted, inner=0, blur=1.5)
    trusted &= clear_of_rails(long, level, trusted)
    _require_pixels(trusted, pair)
    _require_separate(pair, long, trusted)
    scaling = fit_scaling(pair.short, long, trusted)
    free = trusted & clear_of_rails(pair.short, scaling.slope * level + scaling.intercept, trusted, deviations=3.0)
    if MINIMUM_PIXELS <= free.sum() < trusted.sum():
        scaling = fit_scaling(pair.short, long, free)
    signal = scaling.slope * long + scaling.intercept
    railed = signal > rails(pair.short)[1] - 4 * np.std((pair.short - signal)[trusted])
    mask = trusted & ~railed
    _require_pixels(mask, pair)
    total = fit_line(signal[mask], ((pair.short - signal) ** 2)[mask])
    own = own_variance(pair.short, pair.long, mask, scaling, lambda image: registration.warp(image)[0])
    _require_cleaner(pair, total, own, signal[mask])
    lost = covered & ~trusted & ~hot & ~dead
    counts = MaskCounts(*(int(m.sum()) for m in (~covered, (railed & trusted) | lost, hot, dead)))
    return AlignedPair(
        pair.short, pair.long, signal, mask, registration, scaling, total, own, counts, pair.exposure_ratio
    )


def block_split(
    shape: tuple[int, ...], generator: np.random.Generator, *, block: int = 8, fraction: float = 0.5
) -> NDArray[np.bool_]:
    """Choose whole blocks of pixels to judge a model by, so that neighbours do not leak from fit to judgement.

    Args:
        shape: (y, x) of the frame.
        generator: source of the choice.
        block: side of a block, pixels.
        fraction: of the blocks to keep apart.

    Returns:
        (y, x) mask of the pixels kept apart.
    """
    rows, columns = (-(-n // block) for n in shape)
    number = rows * columns
    chosen = np.zeros(number, bool)
    chosen[generator.permutation(number)[: max(1, round(fraction * number))]] = True
    whole = np.kron(chosen.reshape(rows, columns), np.ones((block, block), bool))
    return np.asarray(whole[: shape[0], : shape[1]])


def _require_pixels(mask: Mask, pair: ExposurePair) -> None:
    if mask.sum() < MINIMUM_PIXELS:
        raise ValueError(
            f"only {int(mask.sum())} pixels of {pair.short_name} can be used; the rest are saturated, defective "
            f"or not in {pair.long_name}: give exposures that overlap more, or that are not saturated"
        )


def _require_separate(pair: ExposurePair, long: Image, trusted: Mask) -> None:
    """Frames that differ by a scale and an offset alone have no noise between them."""
    correlation = float(np.corrcoef(pair.short[trusted], long[trusted])[0, 1])
    if 1 - correlation**2 < 1e-9:
        raise ValueError(f"{pair.short_name} is a copy of {pair.long_name}; give two separate exposures of one scene")


def _require_cleaner(pair: ExposurePair, total: VarianceLine, own: VarianceLine, signal: Image) -> None:
    share = float(own(signal).mean()) / float(total(signal).mean())
    if share > LARGEST_SHARE:
        raise ValueError(
            f"{pair.long_name} is noisier than {pair.short_name} ({share:.0%} of their difference is its noise); swap "
            "--short and --long, or give equal exposures as a burst"
        )
