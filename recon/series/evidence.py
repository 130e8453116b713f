"""Evidence for a tilt axis: held-out gaps of tilts, and compactness of the volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from noiseflow.checks import SIGNIFICANT
from recon.projection.classical import sirt
from recon.projection.defocused_projector import gaussian_matrix
from recon.series.holdout import Holdout
from recon.series.matching import ITERATIONS, Match, Matcher, frame, places, sampled
from recon.series.views import HARMLESS, Directions


@dataclass(frozen=True)
class Evidence:
    """Evidence for one tilt axis of a series. Shares are relative to the variance of the images.

    Attributes:
        axis: degrees from y towards −x.
        unexplained: (tilt,) share that a volume from the tilts outside a contiguous gap does not explain in the gap.
        unchanged: (tilt,) the same for images interpolated across the gap without a volume.
        occupied: share of voxels that the volume fills.
        holdout: the gaps.
    """

    axis: float
    unexplained: NDArray[np.float64]
    unchanged: NDArray[np.float64]
    occupied: float
    holdout: Holdout

    @property
    def residual(self) -> float:
        """Unexplained share of the variance in gaps between other tilts."""
        return float(self.unexplained[self.holdout.between].mean())

    def lead_over(self, other: Evidence) -> float:
        """Lead over another axis in the unexplained share, in standard errors over the gaps."""
        return _standard_errors(other.unexplained - self.unexplained, self)

    def is_clear_of(self, other: Evidence) -> bool:
        """Whether the images favour this axis significantly over the other one.

        True axes of simulated series lead by at least five standard errors, and equivalent ones by up to 2.4.

        A rotationally symmetric object has nearly equal images at all angles, which are consistent with any axis. The
        unexplained share then mostly reflects errors of the volume, and the axis is doubtful if the other one gives a more
        compact volume.
        """
        # images interpolated across the gaps then predict the held-out ones better than projections of a volume
        hardly_change = _standard_errors(self.unexplained - self.unchanged, self) > 0
        if hardly_change and self.occupied > HARMLESS["occupied"] * other.occupied:
            return False
        return self.lead_over(other) >= SIGNIFICANT

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return {"tilt_axis_degrees": self.axis, "unexplained_in_gaps": self.residual, "occupied": self.occupied}


def weigh(matcher: Matcher, found: Match, *, gap: float = 15.0, folds: int = 3) -> Evidence:
    """Collect the evidence for an alignment.

    The comparison uses pixels of the raw images, which are not smoothed by interpolation. Otherwise directions along the rows,
    which smooth the noise least and fit it best, would be preferred. The outer gaps are held out like the others, but are not
    counted, because they are extrapolated.

    Args:
        gap: degrees; wider than the gaps of the verdict, because an axis competes with all others: with 12°, the true axis of a
            needle (64² pixels, shifts of one pixel) led the perpendicular one by less than four standard errors.
        folds: one more than the kept gaps between successive held-out ones.
    """
    angles = np.asarray(matcher.projector.tilt_angles)
    directions, holdout = Directions.of(angles), Holdout.gaps(angles, gap)
    view = _View.of(matcher, found)
    mirrored = torch.from_numpy(directions.mirrored).to(view.images.device)[:, None, None]
    facing = torch.where(mirrored, view.images.flip(2), view.images)
    unexplained, unchanged = np.zeros((2, len(angles)))
    for out in holdout.folds(folds):
        across = torch.tensordot(torch.from_numpy(_interpolation(directions.angles, out)).to(facing), facing, 1)
        unexplained[out] = view.errors(view.predicted_without(out))[out]
        unchanged[out] = view.errors(torch.where(mirrored, across.flip(2), across))[out]
    return Evidence(found.degrees, unexplained, unchanged, found.occupied, holdout)


def unexplained_in_halves(matcher: Matcher, found: Match) -> float:
    """Unexplained share of the variance when volumes of every second view predict the others; refines directions locally."""
    view, angles = _View.of(matcher, found), np.asarray(matcher.projector.tilt_angles)
    halves = Holdout.halves(angles).folds(2)
    # converged: after a third of these iterations, the best axis is still wrong by more than a degree
    predicted = ((out, view.predicted_without(out, 9 * ITERATIONS)) for out in halves)
    return float(sum(view.errors(images)[out].sum() for out, images in predicted) / len(angles))


@dataclass(frozen=True)
class _View:
    """Aligned images and the positions of raw pixels in them."""

    matcher: Matcher
    images: Tensor
    seen: Tensor
    there: Tensor
    inside: Tensor

    @classmethod
    def of(cls, matcher: Matcher, found: Match) -> _View:
        shifts = matcher.in_own_pixels(found.shifts)
        images, seen = matcher.aligned(found.axis, shifts)
        raw = places(matcher.images.shape[1:], shifts) - shifts[:, None, None, :]
        there = raw @ frame(found.axis, shifts).T
        inside = sampled(images, there)[1]
        if matcher.used is not None:
            inside = inside * (matcher.used > 1 - HARMLESS["masked part"])
        return cls(matcher, images, seen, there, inside)

    def predicted_without(self, out: NDArray[np.bool_], num_iterations: int = 3 * ITERATIONS) -> Tensor:
        """Predict all images by a volume of those that are not `out`."""
        kept = torch.from_numpy(~out).to(self.images.device)[:, None, None]
        projector = self.matcher.projector
        return projector(sirt(self.images, projector, num_iterations=num_iterations, used=self.seen * kept))

    def errors(self, predicted: Tensor) -> NDArray[np.float64]:
        """(tilt,) squared errors at raw pixels relative to the mean variance of an image, both for smoothed images."""
        measured = self.matcher.images
        squares = self._squares(sampled(predicted, self.there)[0] - measured)
        whole = self._squares(measured - measured.mean()).mean()
        return np.asarray((squares / whole.clamp_min(1e-30)).double().cpu().numpy())

    def _squares(self, difference: Tensor, blur: float = 2.0) -> Tensor:
        """(tilt,) sums of squares after smoothing; the fitted noise depends on the axis, and without, that of a noisy slab was
        wrong by 12°."""
        down, across = (gaussian_matrix(size, blur, like=difference) for size in difference.shape[1:])
        return ((down @ (difference * self.inside) @ across).square() * self.inside).sum((1, 2))


def _interpolation(angles: NDArray[np.float64], out: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(tilt, tilt) weights for linear interpolation in angle from the kept tilts on both sides of each tilt."""
    order = np.flatnonzero(~out)[np.argsort(angles[~out], kind="stable")]
    weights = np.zeros((len(angles), len(angles)), np.float32)
    weights[:, order] = np.stack([np.interp(angles, angles[order], one) for one in np.eye(len(order))], 1)
    return weights


def _standard_errors(difference: NDArray[np.float64], evidence: Evidence) -> float:
    """The mean over gaps between other tilts, divided by its standard error."""
    means = [difference[gap].mean() for gap in evidence.holdout.tilts() if evidence.holdout.between[gap[0]]]
    error = float(np.std(means, ddof=1)) / len(means) ** 0.5 if len(means) > 1 else np.inf
    return float(np.mean(means)) / max(error, 1e-30)
