"""Fits the optical values of a sensor to where its own pattern is seen at rest.

What speaks against the fit is said in words, with what to do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit
from cmp_tactile_processing.calibration.observation import (
    ViewObservation,
    rig_for_any_gap,
    usual_complaint,
)
from cmp_tactile_processing.calibration.outcome import ViewResiduals, finding, number_text
from cmp_tactile_processing.errors import CalibrationError, Finding, InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rig_parameters import RigParameters, RigPrior
from cmp_tactile_processing.geometry.rigid_motion import NEIGHBOURS, local_mean
from cmp_tactile_processing.measured import MAD_TO_STD, Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Uncertainty

# Deviation of a print's corners from the regular pattern, px: the first guess leaves room for all
# that a wrong start may show, then the residuals show it.
FIRST_PRINT_PX, FITS = 1.0, 3
# A corner this many standard deviations off is an outlier.
OUTLIER = 5.0
# A smooth error of the whole surface - its radius, the pitch - is a polynomial of this order;
# where that explains this share of the deviations, nothing local is the matter.
ORDER, EXPLAINED = 3, 0.9

# Parts of the pattern move from frame to frame by this many standard deviations of a corner at
# most: noise alone, averaged over 3 x 3 corners.
NOISE_MOTION = 3.0
# Of the surface's deviations, this many standard deviations may be noise and flaws of the print.
NOISE_SHAPE = 4.0
MOST_LISTED = 6
# The pitch, and the share of its deviation by which it is changed to see what follows it.
PITCH, PITCH_STEP = "pattern.pitch", 0.1


@dataclass(frozen=True)
class GelCalibrationParameters(RigPrior):
    """What may differ from the description by how much, and when the result is good enough.

    A deviation of 0 holds a value: it is not fitted at all.
    """

    # Deviation, in standard deviations, above which it is the description of another sensor.
    largest_deviation: float = 4.0
    # Deviation, in standard deviations, above which a corner counts less.
    robust_scale: float = 3.0
    # Number of frames below which motion of the gel cannot be detected.
    fewest_frames: int = 3
    # Number of frames below which more frames would reduce the noise.
    wanted_frames: int = 8
    # Share of the pattern that each view must show, and below which an object hides the gel.
    least_seen: float = 0.5
    wanted_seen: float = 0.95
    # Common change of the corners between frames above which the gel moved, px.
    still_limit: float = 0.1
    # Distance of the marker surface from its shape at rest, averaged over 3 x 3 corners, m: above
    # the first the gel is touched or the pattern is another one, above the second the description
    # of the pattern should be improved.
    shape_limit: float = 30e-6
    shape_wanted: float = 10e-6
    # RMS of the reprojection residuals of a good calibration, px.
    reprojection_limit: float = 0.5
    # Relative change of all distances together above which the pitch of the pattern is doubtful.
    scale_limit: float = 0.1


@dataclass(frozen=True)
class GelFit:
    """The fitted sensor, its parameters and what the fit knows of them.

    print_px: standard deviation of the corners beyond what the images' noise explains.
    """

    sensor: SensorDescription
    parameters: RigParameters
    fit: MapFit
    print_px: float


def fit_gel(
    sensor: SensorDescription,
    seen: Sequence[ViewObservation],
    options: GelCalibrationParameters,
) -> GelFit:
    """The most probable optical values, given the mean corners and the description as prior.

    Raises CalibrationError where the description cannot be projected to begin with, and where the
    options hold every value.
    """
    parameters = RigParameters(sensor, options)
    if not parameters.free:
        msg = (
            f"{sensor.name}: found standard deviations of 0 for all optical values, expected one "
            "above 0"
        )
        raise CalibrationError(msg)
    print_px, start = FIRST_PRINT_PX, None
    for _ in range(FITS):
        # Each takes the print for as good as the one before found it.
        spread = np.concatenate([np.hypot(view.std[view.seen], print_px) for view in seen])
        fit = map_fit(
            _Residuals(parameters, seen, spread),
            parameters.prior_std,
            start=start,
            robust_scale=options.robust_scale,
        )
        start = fit.values
        print_px = _beyond_noise(fit.residuals.reshape(-1, 2) * spread[:, None], seen)
    return GelFit(parameters.sensor(fit.values), parameters, fit, print_px)


def fitted_uncertainty(
    sensor: SensorDescription,
    seen: Sequence[ViewObservation],
    found: GelFit,
    options: GelCalibrationParameters,
) -> Uncertainty:
    """What the fit leaves open, with all that the description stated before beside it.

    The fit takes the pitch for exact: what another one, by its own deviation, would have found
    comes on top of the fit's covariance.
    """
    pitch_std = sensor.uncertainty.of(PITCH)
    step = PITCH_STEP * pitch_std
    wider = replace(sensor.pattern, pitch=sensor.pattern.pitch * (1 + step))
    spread = np.concatenate([np.hypot(view.std[view.seen], found.print_px) for view in seen])
    other = map_fit(
        _Residuals(RigParameters(replace(sensor, pattern=wider), options), seen, spread),
        found.parameters.prior_std,
        start=found.fit.values,
        robust_scale=options.robust_scale,
    )
    by_pitch = (other.values - found.fit.values) / step
    slopes = np.append(by_pitch, 1.0)
    covariance = pitch_std**2 * np.outer(slopes, slopes)
    covariance[:-1, :-1] += found.fit.covariance
    return sensor.uncertainty.updated((*found.parameters.names, PITCH), covariance)


def view_residuals(
    sensor: SensorDescription, seen: Sequence[ViewObservation], print_px: float
) -> tuple[ViewResiduals, ...]:
    """Measured minus modelled mean corners of each view; outliers are marked as not used."""
    views, pattern = build_views(sensor), sensor.pattern.corners()
    found = []
    for view in seen:
        pixels = view.corners[view.seen]
        residuals = pixels - views[view.view].project(pattern[view.seen])
        spread = np.hypot(view.std[view.seen], print_px)
        used = np.linalg.norm(residuals, axis=-1) <= OUTLIER * np.sqrt(2) * spread
        image = np.zeros(len(pixels), np.intp)
        found.append(ViewResiduals(view.view, pixels, residuals, image, used))
    return tuple(found)


class _Residuals:
    """Whitened residuals of all corners that were seen; NaN where a rig cannot show them."""

    def __init__(
        self,
        parameters: RigParameters,
        seen: Sequence[ViewObservation],
        spread: NDArray[np.float64],
    ) -> None:
        self._parameters, self._spread = parameters, spread[:, None]
        self._pixels = np.concatenate([view.corners[view.seen] for view in seen])
        corners = parameters.sensor(np.zeros(len(parameters.free))).pattern.corners()
        self._points = {view.view: corners[view.seen] for view in seen}

    def __call__(self, changes: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            views = build_views(self._parameters.sensor(changes))
        except InputError:
            return np.full(self._pixels.size, np.nan)
        shown = [views[name].project(points) for name, points in self._points.items()]
        return np.asarray(((self._pixels - np.concatenate(shown)) / self._spread).ravel())


def _beyond_noise(residuals: NDArray[np.float64], seen: Sequence[ViewObservation]) -> float:
    """What the residuals (N, 2) px show beyond the noise of the mean corners, px."""
    spread = MAD_TO_STD * float(np.median(np.abs(residuals)))
    noise = float(np.median(np.concatenate([view.std[view.seen] for view in seen])))
    return float(np.sqrt(max(0.0, spread**2 - noise**2)))


@dataclass(frozen=True)
class GelShape:
    """Deviation of the surface from its shape at rest.

    position (rows, cols, 3) m, deviation (rows, cols, 3) m from the nominal one, averaged over 3 x
    3 corners, z NaN for one view; noise: standard deviation of those averages from the flaws of
    the print and the images' noise, m.  ray_gap (rows, cols) m, NaN for one view.
    """

    position: NDArray[np.float64]
    deviation: NDArray[np.float64]
    noise: float
    ray_gap: NDArray[np.float64]

    @property
    def known(self) -> bool:
        """Whether anything was seen of it."""
        return bool(np.isfinite(self._lengths).any())

    @property
    def peak(self) -> float:
        """The largest deviation, m."""
        return float(np.nanmax(self._lengths)) if self.known else 0.0

    @property
    def peak_corner(self) -> tuple[int, int]:
        """Where it is: row and column."""
        flat = int(np.nanargmax(self._lengths)) if self.known else 0
        row, col = np.unravel_index(flat, self._lengths.shape)
        return int(row), int(col)

    @property
    def rms_gap(self) -> float:
        """Root mean square of the rays' gap, m; NaN for one view."""
        gaps = self.ray_gap[np.isfinite(self.ray_gap)]
        return float(np.sqrt((gaps**2).mean())) if gaps.size else float("nan")

    @property
    def smooth_share(self) -> float:
        """Share of the squared deviations that a smooth error of the whole surface explains."""
        rows, cols = self._lengths.shape
        y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
        known = np.isfinite(self._lengths)
        deviation = np.nan_to_num(self.deviation[known])
        powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
        basis = np.stack([x[known] ** i * y[known] ** j for i, j in powers], axis=1)
        left = deviation - basis @ np.linalg.lstsq(basis, deviation, rcond=None)[0]
        return float(1 - (left**2).sum() / max(float((deviation**2).sum()), 1e-30))

    @property
    def local(self) -> bool:
        """Whether the deviations are those of a contact, not of a wrong shape as a whole."""
        return self.smooth_share < EXPLAINED

    @property
    def _lengths(self) -> NDArray[np.float64]:
        known = np.isfinite(self.deviation[..., :2]).all(axis=-1)
        lengths = np.linalg.norm(np.nan_to_num(self.deviation), axis=-1)
        return np.where(known, lengths, np.nan)


def gel_shape(sensor: SensorDescription, seen: Sequence[ViewObservation]) -> GelShape:
    """The surface that the mean corners show."""
    rig = rig_for_any_gap(sensor)
    grids = {view.view: _grid(sensor, view) for view in seen}
    markers = rig.triangulate(grids.get("left"), grids.get("right"))
    off = markers.position - sensor.pattern.corners()
    known = off[..., : 2 if len(seen) < 2 else 3]
    smooth = local_mean(known)
    rough = np.linalg.norm(known - smooth, axis=-1)
    rough = rough[np.isfinite(rough)]
    noise = float(np.median(rough)) / NEIGHBOURS**0.5 if rough.size else 0.0
    deviation = np.concatenate([smooth, off[..., known.shape[-1] :]], axis=-1)
    return GelShape(markers.position, deviation, noise, markers.ray_gap)


def _grid(sensor: SensorDescription, view: ViewObservation) -> Grid:
    empty = Grid.missing(sensor.pattern.shape, "")
    status = np.where(view.seen, Status.MEASURED, Status.MISSING).astype(np.uint8)
    return replace(empty, corners=view.corners, corner_status=status, corner_std=view.std)


def frame_list(numbers: Sequence[int]) -> str:
    """Frames of these indices, from 0, by their numbers from 1: "frames 2, 5, 6"."""
    listed = ", ".join(str(number + 1) for number in numbers[:MOST_LISTED])
    more = f" and {len(numbers) - MOST_LISTED} more" if len(numbers) > MOST_LISTED else ""
    return f"frame{'s' if len(numbers) > 1 else ''} {listed}{more}"


def count_findings(count: int, options: GelCalibrationParameters) -> list[Finding]:
    """Too few frames that show the pattern?"""
    if count >= options.wanted_frames:
        return []
    few = count < options.fewest_frames
    only = f"Only {count} frame{'s' if count != 1 else ''} could be used"
    values = {"only": only, "wanted": options.wanted_frames}
    return [finding("too few frames" if few else "few frames", error=few, **values)]


def sight_findings(
    grids: Mapping[str, Sequence[Grid]],
    seen: Sequence[ViewObservation],
    options: GelCalibrationParameters,
) -> list[Finding]:
    """Is the pattern hidden in some frames, or a part of it in all?"""
    findings = []
    for name, view in grids.items():
        bad = [k for k, grid in enumerate(view) if grid.found_fraction < options.least_seen]
        if bad:
            values = {"view": name, "least": options.least_seen, "frames": frame_list(bad)}
            complaint = usual_complaint([view[k] for k in bad])
            findings.append(finding("frames left out", error=False, complaint=complaint, **values))
    for item in seen:
        share = float(item.seen.mean())
        if share >= options.wanted_seen:
            continue
        values = {"view": item.view, "share": share, "complaint": usual_complaint(item.grids)}
        findings.append(finding("part hidden", error=share < options.least_seen, **values))
    return findings


def motion_findings(
    seen: Sequence[ViewObservation], options: GelCalibrationParameters
) -> list[Finding]:
    """Do the frames differ?"""
    findings = []
    for item in seen:
        limit = max(options.still_limit, NOISE_MOTION * item.noise)
        motion = item.motion
        moved = [int(number) for number in item.numbers[motion > limit]]
        if moved:
            texts = {"most": number_text(motion.max(), 2), "limit": number_text(limit, 2)}
            values = {"frames": frame_list(moved), "view": item.view, **texts}
            findings.append(finding("moved", error=True, **values))
    return findings


def shape_findings(
    sensor: SensorDescription, shape: GelShape, options: GelCalibrationParameters
) -> list[Finding]:
    """Is the surface, measured with the result, the one at rest?"""
    beyond = shape.peak - NOISE_SHAPE * shape.noise
    if beyond <= options.shape_wanted:
        return []
    error = beyond > options.shape_limit
    row, col = shape.peak_corner
    x, y = sensor.pattern.corners()[row, col, :2] * 1e3
    off = shape.deviation[row, col] * 1e3
    how = "by " + ", ".join(
        f"{value:+.3f} mm along {axis}"
        for axis, value in zip("xyz", off, strict=True)
        if np.isfinite(value)
    )
    place = f"x = {x:.1f} mm, y = {y:.1f} mm"
    if shape.local:
        return [finding("touched", error=error, place=place, row=row, col=col, how=how)]
    surface, pitch = sensor.pattern.surface, sensor.pattern.pitch * 1e3
    known = f" of radius {surface.radius * 1e3:.4g} mm" if np.isfinite(surface.radius) else ""
    values = {"place": place, "how": how, "pitch": pitch, "surface": f"{surface.type}{known}"}
    return [finding("other surface", error=error, **values)]


def deviation_findings(
    sensor: SensorDescription, found: GelFit, options: GelCalibrationParameters
) -> list[Finding]:
    """Did the fit go further than a sensor of this kind may differ from its description?"""
    findings = []
    far = found.fit.deviations > options.largest_deviation
    if far.any():
        names = [name for name, is_far in zip(found.parameters.names, far, strict=True) if is_far]
        verb = "differ" if len(names) > 1 else "differs"
        values = {"names": f"{', '.join(names)} {verb}", "limit": options.largest_deviation}
        findings.append(finding("too far", error=True, **values))
    growth = _growth(sensor, found.sensor)
    if abs(growth) > options.scale_limit:
        values = {"share": abs(growth), "pitch": sensor.pattern.pitch * 1e3}
        changed = "grew" if growth > 0 else "shrank"
        findings.append(finding("scaled", error=False, changed=changed, **values))
    return findings


def reprojection_findings(rms: float, options: GelCalibrationParameters) -> list[Finding]:
    """Does the fitted model describe the images?  rms: px, of the corners that are no outliers."""
    if rms <= options.reprojection_limit:
        return []
    values = {"rms": number_text(rms, 2), "limit": options.reprojection_limit}
    return [finding("reprojection", error=True, **values)]


def _growth(before: SensorDescription, after: SensorDescription) -> float:
    """Relative change of the mean distance from the views' centres to the apex of the gel."""
    distances = [
        np.mean([np.linalg.norm(view.centre) for view in build_views(sensor).values()])
        for sensor in (before, after)
    ]
    return float(distances[1] / distances[0] - 1)
