"""Search for the alignment of a raw tilt series jointly with a coarse volume."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from noiseflow.progress import Progress
from recon.series.alignment import Alignment
from recon.series.evidence import Evidence, unexplained_in_halves, weigh
from recon.series.first_guess import estimate_response
from recon.series.masks import plausible
from recon.series.matching import FARTHEST, ROUNDS, Match, Matcher
from recon.series.tilt_series import TiltSeries
from recon.series.views import without_level

_COARSEST, _SEARCHED, _FINEST = 16, 64, 160
SPACING = 15.0  # degrees: at 24 pixels, neighbours differ by three pixels at the edge, the longest step of a refinement
KEPT = 3
"""Directions that are refined, and twice as many after the smallest size."""
_SAME = 20.0  # degrees: closer axes are the same solution at different convergence, with similar volumes


class AxisUndetermined(ValueError):
    """The images are consistent with several directions of the tilt axis.

    Attributes:
        candidates: evidence for each direction, best first.
    """

    def __init__(self, candidates: Sequence[Evidence]) -> None:
        self.candidates = tuple(candidates)
        first, second = self.candidates[:2]
        super().__init__(
            f"the images do not determine the tilt axis: {_words(first)}, {_words(second)}; give its approximate direction "
            f"from the microscope: --tilt-axis {first.axis:.0f} or --tilt-axis {second.axis:.0f}"
        )


def _words(evidence: Evidence) -> str:
    return f"{evidence.axis:.1f}° explains {1 - evidence.residual:.1%} of held-out tilts"


def find_alignment(
    tilt_series: TiltSeries,
    *,
    tilt_axis: float | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Alignment:
    """Find the tilt axis and the shift of every image jointly with a volume, at widths from 16 pixels to full size, at most 160.

    At each size, SIRT iterations with the current alignment alternate with Gauss–Newton steps of all shifts and the axis towards
    the projections of the volume. At the smallest size, directions all around are tried, starting without shifts and with shifts
    from cross-correlation of neighbours. Three directions are refined at the next sizes and compared by held-out contiguous gaps
    of tilts. The best one must be significantly better than the others.

    Args:
        tilt_series: raw images, in any orientation.
        tilt_axis: degrees from y towards −x, if known to a few degrees; searched if None.

    Raises:
        AxisUndetermined: several directions fit equally well and none was given (a `ValueError`).
        ValueError: there are fewer than five tilts.
    """
    if tilt_series.num_tilts < 5:
        raise ValueError(f"{tilt_series.num_tilts} tilts are too few to align; remove --refine-alignment")
    with torch.no_grad():
        search = _Search(tilt_series, tilt_axis, device, progress)
        match, evidence = search.run()
    found = Alignment.unshifted(tilt_series, search.stated(match.degrees))
    return replace(found, shifts=match.shifts.double().cpu().numpy(), evidence=tuple(evidence))


@dataclass(frozen=True)
class _Candidate:
    """A candidate direction; `known` if it was given or is in the metadata, or is close to such a direction."""

    match: Match
    evidence: Evidence
    known: bool = False


class _Search:
    """The candidates through all sizes."""

    def __init__(
        self, series: TiltSeries, tilt_axis: float | None, device: torch.device | str, progress: Progress | None
    ) -> None:
        self.angles, self.given, self.progress = series.tilt_angles, tilt_axis, progress
        self.known = series.tilt_axis if tilt_axis is None else tilt_axis
        self.images = line_integrals_of(series).to(device)
        self.used = None if series.mask is None else torch.from_numpy(series.mask).float().to(device)
        size = max(series.images.shape[1:])
        self.binnings = binnings(series.images.shape[1:], _COARSEST, _FINEST)
        self.searched = min((each for each in self.binnings if size // each <= _SEARCHED), default=self.binnings[0])

    def run(self) -> tuple[Match, list[Evidence]]:
        """Return the alignment, and the evidence for its axis and for the other candidates."""
        candidates: list[_Candidate] = []
        decided = False
        for done, binning in enumerate(self.binnings):
            matcher = Matcher(self.images, self.angles, binning, self.used)
            if not candidates:
                candidates = _distinct(self._first(matcher), 2 * KEPT, SPACING)
            elif matcher.size <= _SEARCHED:
                candidates = self._refined(matcher, candidates)
            for _ in range(ROUNDS if binning == self.searched else 0):  # wrong directions move towards the true one
                if self._equal(candidates):
                    candidates = self._refined(matcher, candidates)
            if matcher.size > _SEARCHED or binning == self.binnings[-1]:
                chosen = candidates[0] if decided else self._decided(candidates)
                others = [each for each in candidates if each is not chosen]
                match = matcher.match(chosen.match.axis, chosen.match.shifts, free_axis=True)
                candidates, decided = [replace(chosen, match=match), *others], True
            if self.progress is not None:
                self.progress("aligning", done + 1, len(self.binnings), f"axis {candidates[0].match.degrees:.2f}°")
        return matcher.centred(candidates[0].match), [self._evidence(each) for each in candidates]

    def stated(self, degrees: float) -> float:
        """The direction of a line, which determines the handedness: the known one, or the one within 90° of y."""
        return degrees + 180 * round(((self.known or 0.0) - degrees) / 180)

    def _evidence(self, candidate: _Candidate) -> Evidence:
        return replace(candidate.evidence, axis=self.stated(candidate.evidence.axis))

    def _first(self, matcher: Matcher) -> list[_Candidate]:
        """Candidates all around from two starting points, at the smallest size."""
        ranked = np.argsort(self.angles, kind="stable").tolist()
        upright = int(np.argmin(np.abs(self.angles[ranked])))
        up, down = (matcher.neighbours_correlated(half) for half in (ranked[upright:], ranked[upright::-1]))
        directions = {float(degrees): False for degrees in np.arange(-90, 90, SPACING)}
        if self.given is not None:  # three other directions as a check
            directions = {self.given + turn: turn == 0 for turn in (0.0, 45.0, 90.0, 135.0)}
        elif self.known is not None:
            directions[self.known] = True
        tried = [
            (matcher.match(math.radians(degrees), start), known)
            for degrees, known in directions.items()
            for start in (torch.zeros_like(up), up + down)
        ]
        return [_weighed(matcher, match, known) for match, known in tried]

    def _refined(self, matcher: Matcher, candidates: list[_Candidate]) -> list[_Candidate]:
        """Refine shifts and axes at a larger size; return the best few, best first."""
        best, *others = _distinct([self._matched(matcher, each) for each in candidates], KEPT, _SAME)
        rivals = self._equal([best, *others])
        beaten = [each for each in others if each not in rivals]
        turned = [_turned(matcher, each) for each in (best, *rivals)]
        found = _distinct(
            [each if self._strayed(each) is None else old for each, old in zip(turned, (best, *rivals), strict=True)],
            KEPT,
            _SAME,
        )
        compact = min(others, key=lambda each: each.evidence.occupied, default=None)
        return found + [each for each in beaten if each.known or each is compact or len(found) == 1]

    def _matched(self, matcher: Matcher, candidate: _Candidate) -> _Candidate:
        old = candidate.match
        found = _weighed(matcher, matcher.match(old.axis, old.shifts, free_axis=True), candidate.known)
        if (back := self._strayed(found)) is None:
            return found
        return _weighed(matcher, matcher.match(back, old.shifts), candidate.known)

    def _strayed(self, candidate: _Candidate) -> float | None:
        """The stated direction, radians, if a candidate that started there has moved away; otherwise None."""
        if self.known is None or not candidate.known or _between(candidate.match.degrees, self.known) < _SAME:
            return None
        return math.radians(self.known)

    def _equal(self, candidates: list[_Candidate]) -> list[_Candidate]:
        """The candidates that are not significantly worse than the best."""
        best, *others = candidates
        return [each for each in others if not best.evidence.is_clear_of(each.evidence)]

    def _decided(self, candidates: list[_Candidate]) -> _Candidate:
        """The candidate that is significantly better than all others, or that is known.

        Raises:
            AxisUndetermined: there is no such candidate.
        """
        best = candidates[0]
        known = next((each for each in candidates if each.known), None)
        equal = self._equal(candidates)
        if known is not None and known is not best and known not in equal:
            advice = (
                "the given direction is used" if self.given is not None else "the direction from the images is used"
            )
            warnings.warn(
                f"the stated tilt axis is {self.known:.0f}°, but {_words(self._evidence(best))} and "
                f"{_words(self._evidence(known))}; {advice}",
                stacklevel=5,
            )
            return known if self.given is not None else best
        if known is None and equal:
            raise AxisUndetermined([self._evidence(each) for each in (best, *equal)])
        return known or best


def _distinct(candidates: list[_Candidate], count: int, apart: float) -> list[_Candidate]:
    """The best candidates at least `apart` from each other, best first; includes the known and the most compact one."""
    kept: list[_Candidate] = []
    compact = min(candidates, key=lambda candidate: candidate.evidence.occupied)
    for each in sorted(candidates, key=lambda candidate: candidate.evidence.residual):
        near = next(
            (i for i, other in enumerate(kept) if _between(each.match.degrees, other.match.degrees) < apart), None
        )
        wanted = each is compact or (each.known and not any(other.known for other in kept))
        if near is None and (len(kept) < count or wanted):
            kept.append(each)
        elif near is not None and each.known:
            kept[near] = replace(kept[near], known=True)
    return kept


def _between(one: float, other: float) -> float:
    """Angle between two lines, degrees."""
    return abs((one - other + 90) % 180 - 90)


def _weighed(matcher: Matcher, match: Match, known: bool) -> _Candidate:
    return _Candidate(match, weigh(matcher, match), known)


def _turned(matcher: Matcher, candidate: _Candidate) -> _Candidate:
    """The axis at the minimum of a parabola through three directions, by the unexplained share of every second tilt."""
    found, step = candidate.match, FARTHEST / matcher.size

    def tried(start: Match, turn: float) -> tuple[float, Match]:
        match = matcher.match(*matcher.about_mass(start, turn), rounds=ROUNDS)
        return unexplained_in_halves(matcher, match), match

    sides = [tried(found, side * step) for side in (-1.0, 0.0, 1.0)]
    left, middle, right = (residual for residual, _ in sides)
    curvature = left - 2 * middle + right
    place = 0.5 * (left - right) / curvature if curvature > 0 else math.copysign(1.5, left - right)
    nearest = min(sides, key=lambda pair: pair[0])
    turn = found.axis + step * min(max(place, -1.5), 1.5) - nearest[1].axis
    best = min(nearest, tried(nearest[1], turn), key=lambda pair: pair[0])[1]
    return _weighed(matcher, best, candidate.known)


def line_integrals_of(tilt_series: TiltSeries) -> Tensor:
    """Images as line integrals, of order one."""
    lowered, _ = without_level(plausible(tilt_series))
    integrals = estimate_response(lowered).invert(torch.from_numpy(lowered.images)).detach()
    return integrals / integrals.std().clamp_min(1e-30)


def binnings(sides: Sequence[int], coarsest: int, finest: int) -> list[int]:
    """Binning factors for widths from about the coarsest, doubling each time, to at most the finest; a row of a strip stays."""
    size, most = max(sides), min(sides)
    found = [max(1, round(size / coarsest))]
    while found[-1] > max(1, math.ceil(size / finest)):
        found.append(max(math.ceil(found[-1] / 2), math.ceil(size / finest)))
    return list(dict.fromkeys(min(each, most) for each in found))
