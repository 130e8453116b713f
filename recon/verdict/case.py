"""A reconstruction to assess, with what several checks need: residuals, distortions, and predictions of held-out tilts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from noiseflow.checks import MOST, SIGNIFICANT, Effect, NotTested
from noiseflow.statistics import Array, robust_deviation, white_regression
from recon.projection.image_formation import Linear, Transmission
from recon.series import first_guess
from recon.series.alignment import Alignment
from recon.series.masks import coarse
from recon.series.screening import Screening
from recon.series.shrinkage import estimate_shrinkage
from recon.series.tilt_series import TiltSeries, VolumeGrid, evenly
from recon.series.views import AROUND, HARMLESS
from recon.verdict import tilts
from recon.verdict.compared import Coarse, Fitted, Residuals, Result, coarse_series, expected_images, line_integrals
from recon.verdict.distortions import Distortion, distortions, uneven_across, uneven_vacuum
from recon.verdict.geometry import Geometry, shared
from recon.verdict.moments import Violations, violations
from recon.verdict.sharpness import sharp_integrals
from recon.verdict.tilts import gaps_between

# widths: only this number of slices of a taller series is used, because all may not fit into memory
_TALL = 4
# standard errors of the structure common to neighbouring pixels: with less, no object is visible
VISIBLE = 8.0


@dataclass(frozen=True)
class Case:
    """A reconstruction to assess; what several checks need is computed once, by the first that needs it.

    Attributes:
        tilt_series: the reconstructed series.
        result: volume and projections (tilt, y, u), detector units.
        screening: screening of all tilts, if done.
        alignment: alignment of the raw images, if done.
    """

    tilt_series: TiltSeries
    result: Result
    screening: Screening | None = None
    alignment: Alignment | None = None

    @cached_property
    def rows(self) -> slice:
        """The slices that are used."""
        return first_guess.contrast_slab(self.tilt_series, _TALL * self.tilt_series.images.shape[2])

    @cached_property
    def series(self) -> TiltSeries:
        """The series in these slices, with the beam that the fit found in bright field."""
        series, at = self.tilt_series.rows(self.rows), getattr(self.result, "tilts", None)
        if self.fitted is None or self.fitted.vacuum_ratios.numel() == 1:
            return series
        beam = self.fitted.vacuum_ratios.flatten().double().cpu().numpy()
        return replace(series, beam=beam if at is None else beam[at])

    @cached_property
    def expected(self) -> Array:
        """(tilt, y, u) expected images of the volume in these slices, detector units."""
        return expected_images(self.result, self.rows)

    @cached_property
    def residuals(self) -> Residuals:
        """Images minus their expectation."""
        return Residuals.of(self.series, self.expected)

    @cached_property
    def left_out(self) -> Residuals:
        """Coarse line integrals of the volume, and what each tilt differs from them by more than the other tilts predict.

        The volume is subtracted before, so that what the method has not fitted yet is predicted by the others, not blamed on
        the images.
        """
        coarse, (own, _) = self.coarse, self.own
        errors = self.geometry.single.errors(self.misfit, coarse.used)
        # isolated larger errors are spikes, which move no image
        most = SIGNIFICANT * robust_deviation(errors[coarse.used], 0.0)
        errors, order = np.clip(errors, -most, most), np.argsort(coarse.tilt_angles, kind="stable")
        height = np.arange(own.shape[1]) - (own.shape[1] - 1) / 2
        images, own, errors, used = (each[order] for each in (own + errors, own, errors, coarse.used))
        return Residuals(images, own, errors, used, coarse.tilt_angles[order], height)

    @cached_property
    def distortions(self) -> dict[str, Distortion]:
        """Distortions of each image relative to what the others predict."""
        return distortions(self.left_out, pixel=self.coarse.binning)

    @property
    def screened(self) -> Screening:
        """The screening of all tilts. Raises `NotTested` without one."""
        if self.screening is None:
            raise NotTested("the tilts were not screened")
        return self.screening

    @cached_property
    def explained(self) -> tuple[float, float]:
        """Shares of the images that coarse volumes explain, as given and with inverted contrast."""
        return first_guess.explained_both(self.series)

    @cached_property
    def integrals(self) -> Array:
        """(tilt, y, u) line integrals of the slices with the highest contrast, sorted by angle."""
        return sharp_integrals(self.series, self.residuals, self.fitted)

    @cached_property
    def coarse(self) -> Coarse:
        """Coarse line integrals."""
        depth, _, width = np.shape(self.result.volume.attenuation)
        width *= first_guess.SIDES if self.section else 1
        return coarse_series(self.series, VolumeGrid(depth, self.rows.stop - self.rows.start, width), self.fitted)

    @cached_property
    def section(self) -> bool:
        """Whether the specimen goes on beside the images."""
        return first_guess.beyond_sides(coarse(self.series))

    @property
    def fitted(self) -> Fitted:
        """The response of the fit; None if there is none."""
        response = getattr(getattr(self.result, "signal_model", None), "image_formation", None)
        return response if isinstance(response, Transmission | Linear) else None

    @cached_property
    def geometry(self) -> Geometry:
        """Predictions of held-out gaps of tilts."""
        return Geometry(self.coarse)

    @property
    def misfit(self) -> Array:
        """(tilt, y, u) coarse line integrals of the images minus those of the volume; zero where masked."""
        own, used = self.own
        return np.asarray((self.coarse.images - own) * used)

    @cached_property
    def own(self) -> tuple[Array, Array]:
        """(tilt, y, u) coarse line integrals of the volume's own projections, and the pixels in use."""
        expected = self.expected[evenly(self.coarse.tilts, len(self.expected))]
        return line_integrals(self.series.select(self.coarse.tilts), expected, self.coarse.binning, self.fitted)

    @property
    def other_geometries(self) -> Geometry:
        """The same, where other geometries can be compared. Raises `NotTested` otherwise."""
        if len(gaps_between(self.coarse.tilt_angles)) < AROUND:
            raise NotTested(f"needs {AROUND} directions")
        if self.geometry.structure < VISIBLE:
            raise NotTested("no object is visible")
        return self.geometry

    @property
    def whole(self) -> Case:
        """The case, if the images show the whole object. Raises `NotTested` otherwise."""
        if self.section:
            raise NotTested("the object extends beyond the sides of the images")
        return self

    @cached_property
    def moments(self) -> Violations:
        """The faults that the moments of the rows require. Raises `NotTested` if the object is not within the field."""
        geometry, used = self.whole.other_geometries, self.coarse.used
        fitted = geometry.fit.fitted
        whole = np.where(used, self.coarse.images, self.own[0])
        replicates = np.where(used, geometry.replicates, geometry.smooth)
        of_them = geometry.fitted_replicates if used.all() else (fitted(each) for each in replicates)
        return violations(self.coarse, whole, fitted, zip(replicates, of_them, strict=True))

    def share(self, images: Array) -> float:
        """Structure common to neighbouring rows of coarse images, relative to that of the series."""
        return shared(images) / self.structure

    @cached_property
    def structure(self) -> float:
        """Structure common to neighbouring rows of the coarse series, at least that of noise by chance."""
        flat = self.coarse.centred_on_all
        return max(shared(flat), float(np.mean(flat**2)) / float(np.sqrt(flat.size)), 1e-30)

    @property
    def noise(self) -> float:
        """Power of what a linear fit leaves, relative to the structure."""
        return float(np.mean(self.geometry.left**2)) / self.structure

    @cached_property
    def gaps(self) -> float:
        """`share` of the errors of held-out gaps."""
        return self.share(self.geometry.errors)

    @cached_property
    def gaps_of_replicates(self) -> Array:
        """(replicate,) `share` of the errors of held-out gaps."""
        fit, used = self.geometry.fit, self.coarse.used
        return np.array([self.share(fit.errors(images, used)) for images in self.geometry.replicates])


def inconsistent(case: Case) -> Effect:
    """Unexplained share of the structure of held-out gaps beyond that of replicates."""
    return beyond(case.gaps, case.gaps_of_replicates)


def tolerable(case: Case) -> float:
    """As much as replicates leave, because they are smoother than the images, and a share for what no fit can represent."""
    return max(float(case.gaps_of_replicates.mean()), 0.0) + 0.02


def beyond(value: float, replicates: Array, what: str = "") -> Effect:
    """A statistic above its mean over replicates, with the standard error of their difference."""
    error = float(np.std(replicates, ddof=1)) * float(np.sqrt(1 + 1 / len(replicates)))
    return Effect(max(0.0, value - float(np.mean(replicates))), error, what)


def of_tilts(statistic: Callable[..., Effect], case: Case, errors: Callable[[Array], Array] | None = None) -> Effect:
    """A statistic of the coarse images beyond that of replicates; `errors` predicts each of them from the others."""

    def measured(images: Array) -> Effect:
        coarse = replace(case.coarse, images=images)
        return statistic(coarse) if errors is None else statistic(coarse, errors(images))

    found = measured(case.coarse.images)
    return beyond(found.value, np.array([measured(images).value for images in case.geometry.replicates]), found.what)


def unlike_neighbours(case: Case) -> Effect:
    """Deviation of the worst tilt from what its neighbours predict, in typical deviations beyond those of replicates."""
    if case.coarse.images.shape[1] < 2 or len(case.coarse.images) < 2 * AROUND:
        raise NotTested(f"needs two rows and {2 * AROUND} tilts")
    fit, used = case.geometry.smooth_single, case.coarse.used
    return of_tilts(tilts.single, case, lambda images: fit.errors(images, used))


def beyond_the_sides(case: Case) -> Effect:
    """Signal at the sides relative to the mean, if held-out gaps, or the images by their own volume, are not explained either."""
    found = inconsistent(case)
    unexplained = found.value > max(0.5 * tolerable(case), SIGNIFICANT * found.error)
    unexplained |= case.section and left_of_own_images(case) > tolerable_convergence(case)
    return Effect(first_guess.at_sides(coarse(case.series)) if unexplained and case.other_geometries.structure else 0.0)


def alike(case: Case) -> Effect:
    """Share of the structure that all images have in common, if the object goes on beside them."""
    images = case.coarse.centred_on_all
    return Effect(max(0.0, 1 - case.share(images - images.mean(0))) if case.section else 0.0)


def still(case: Case) -> Effect:
    """Structure of the mean image without an axis of symmetry, which a turn must change: by 0.6 of it in blobs, 0.03 if still."""
    common = (images := case.whole.coarse.centred_on_all).mean(0)
    odd = min(case.share((common - np.roll(common[:, ::-1], by, 1))[None] / 2) for by in range(images.shape[2]))
    seen = np.cos(np.deg2rad(gaps_between(case.coarse.tilt_angles)[0])) >= 0 and case.geometry.structure >= VISIBLE
    least = HARMLESS["contrast"]
    return Effect(odd / max(case.share(images - common) / least, least) if seen else 0.0)


def uneven_illumination(case: Case) -> Effect:
    """What vacuum shows of it, or held-out gaps: the more certain one. Matter beside the images would predict gaps better."""
    found = uneven_vacuum(case.coarse)
    with suppress(NotTested):
        geometry, known = case.other_geometries, case.geometry.errors
        if case.section:
            geometry = Geometry(replace(case.coarse, width=case.coarse.width // first_guess.SIDES))
        across, left = uneven_across(geometry)
        if not case.section or np.mean(left**2) < np.mean(known**2):
            found = max(found, across, key=lambda effect: effect.value - SIGNIFICANT * effect.error)
    return found


def inverted(case: Case) -> Effect:
    """Share of the images that a coarse non-negative volume explains with inverted contrast, minus that as given."""
    as_given, swapped = case.explained
    return Effect(max(0.0, swapped - as_given), what=f"{max(as_given, 0):.0%} of the images, and {swapped:.0%}")


def cut_off(case: Case) -> Effect:
    """Density of the top or bottom layer relative to the mean: material beyond a thin volume is projected into them."""
    volume = case.result.volume.attenuation
    depth, height, width = volume.shape
    if depth >= width:
        return Effect(0.0)
    layers = np.abs(volume[:, :: max(1, height // 64)]).mean((1, 2), dtype=np.float64)
    return Effect(float(max(layers[0], layers[-1]) / max(float(layers.mean()), 1e-30)))


def changing_size(case: Case, *, most: float = 0.25) -> Effect:
    """Change of the size of the specimen over the series, in the order of the dose; see `recon.series.shrinkage`. Polymers lose
    up to a fifth under the beam; a change larger than `most` has another cause and is not tested."""
    found = estimate_shrinkage(case.series)
    if abs(found.change) > most:
        raise NotTested("the profile along the axis changes by more than any change of size")
    return Effect(found.change if found.found else 0.0, found.error, found.order)


def unconverged(case: Case) -> Effect:
    """`left_of_own_images`, unless it may be what lies beside a volume that is as narrow as the images."""
    if inverted(case.whole).value > HARMLESS["contrast"]:
        raise NotTested("no volume explains inverted contrast")
    return Effect(left_of_own_images(case))


def left_of_own_images(case: Case) -> float:
    """Structure that the volume leaves of its own images beyond what a linear fit leaves of images that it has not seen."""
    used, misfit = case.coarse.used, case.misfit
    left = (misfit - misfit[used].mean()) * used  # an offset is no structure
    return max(0.0, case.share(left) - max(case.gaps, 0.0))


def tolerable_convergence(case: Case) -> float:
    """14 % of the contrast, and a fifth of the noise power, of which a volume without negative values makes a background."""
    return 0.02 + 0.2 * case.noise


def left_in_residuals(case: Case) -> Effect:
    """Share of the structure of the images that no volume explains, beyond that of replicates."""
    geometry, misfit = case.geometry, case.misfit
    pairs = zip(geometry.replicates, geometry.fitted_replicates, strict=True)
    replicates = [case.share((images - fitted) * case.coarse.used) for images, fitted in pairs]
    return beyond(case.share(misfit - geometry.fit.fitted(misfit)), np.array(replicates))


def between_tilts(case: Case) -> Effect:
    """Share of the structure of single directions that a linear fit of the other ones does not explain, in images that are
    projections of one volume: neither noise nor misalignment adds to it. Too few tilts to be compared are no good series."""
    count = len(gaps_between(case.coarse.tilt_angles))
    if count <= AROUND:
        return Effect(MOST, what=f"{count}")
    geometry = (
        case.whole.other_geometries
    )  # no number of tilts predicts images of noise, or what comes in from the sides
    left = shared(geometry.single.errors(geometry.smooth)) / max(shared(geometry.smooth), 1e-30)
    return Effect(left, what=f"{count}")


def other_scale(case: Case) -> Effect:
    """Error of the tilt angles as a share: of a section, by its thickness in the images; otherwise from the moments, if the other
    angles explain held-out tilts better."""
    if first_guess.behind_section(small := coarse(case.series)) is not None:
        scale, error = first_guess.scale_by_section(small)
        return Effect(scale - 1, error)
    found = case.moments.scale
    if abs(found.value) < SIGNIFICANT * found.error:
        return found
    gain = case.other_geometries.rescaled(1 + found.value)
    return found if gain.value > 0 else found._replace(value=0.0)


def direction_of_axis(case: Case) -> Effect:
    """Rotation of the axis in the images, and the direction in the raw ones, which is what --tilt-axis takes."""
    applied, found = case.alignment.tilt_axis if case.alignment else 0.0, case.moments.direction
    return found._replace(what=f"{applied + found.value:.1f}")


def trend(case: Case) -> Effect:
    """Steady change of the brightness from the first tilt to the last."""
    screening = case.screened
    beam, place = np.log(screening.beam[~screening.bad]), np.linspace(-0.5, 0.5, int((~screening.bad).sum()))
    (_, slope), (_, error) = white_regression(np.stack([np.ones_like(place), place], 1), beam)
    return Effect(float(slope), float(error))


def with_noise(share: float) -> Callable[[Case], float]:
    """A tolerance that grows with the noise, whose squares leave more."""
    return lambda case: share * (1 + 2 * case.noise)
