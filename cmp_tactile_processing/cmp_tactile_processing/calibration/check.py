"""Does a recording keep to what the sensor's calibration promises?

Works on any recording, at rest or in contact: the two views must agree in every frame; frames of
the gel at rest must also show it where the description has it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration import observation, outcome
from cmp_tactile_processing.calibration.outcome import finding
from cmp_tactile_processing.errors import CalibrationError, Finding, Severity, errors_in
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.geometry.rigid_motion import (
    LEAST_MARKERS,
    largest_local_mean,
    similarity,
)
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.stillness import largest_motion, motion_limit, rest_shape

JUDGED_PERCENT = 95.0


@dataclass(frozen=True)
class CheckParameters:
    """What a recording of a well calibrated sensor keeps to.

    The limits of statistics hold for 95 % of the markers.
    """

    # Distance of a corner from the projection of its point in space, px.
    reprojection: float = 0.3
    # Distance of a corner of the right view from the epipolar curve of the left view's ray, px.
    epipolar: float = 0.6
    # Distance between the rays of both views at a marker, m.
    ray_gap: float = 25e-6
    # Share of the markers that both views measured in all frames.
    tracked: float = 0.8
    # Deviation from the shape at rest, apart from a common shift and scale, up to which nothing
    # touches the gel, m.
    rest_shape: float = 60e-6
    # Rotation (rad), shift (m) and relative growth of the gel at rest since the calibration.
    turn: float = 5e-3
    shift: float = 50e-6
    scale: float = 5e-3
    # Deviation of the gel at rest from its known shape, apart from a rigid motion, m.
    shape: float = 30e-6
    # RMS distance of the corners at rest from the description, px.
    rest_reprojection: float = 1.0


@dataclass(frozen=True)
class RigidDrift:
    """The measured surface is the nominal one, turned by `turn` (3,) rad about the apex, grown by
    `growth` and shifted by `shift` (3,) m; what is left is `residual` (rows, cols, k) m.

    One view shows a turn about z and shifts along x and y alone, with k = 2; the rest is 0.
    """

    turn: NDArray[np.float64]
    shift: NDArray[np.float64]
    growth: float
    residual: NDArray[np.float64]

    @property
    def shape_peak(self) -> float:
        """The largest residual, averaged over 3 x 3 corners, m."""
        largest = largest_local_mean(self.residual)
        return math.inf if math.isnan(largest) else largest


def rigid_drift(position: NDArray[np.float64], nominal: NDArray[np.float64]) -> RigidDrift | None:
    """Best similarity from nominal (rows, cols, 3) to measured positions, gel frame, m.

    z of `position` is NaN for one view.  None where fewer than six corners are known.
    """
    dims = 2 if np.isnan(position[..., 2]).all() else 3
    known = np.isfinite(position[..., :dims]).all(axis=-1)
    if int(known.sum()) < LEAST_MARKERS:
        return None
    flat = np.array([1.0, 1.0, float(dims == 3)])
    p, q = nominal[known] * flat, np.nan_to_num(position[known]) * flat
    R, scale, moved = similarity(p, q, scaled=True)
    middle = p.mean(axis=0)
    shift = middle + moved - scale * R @ middle
    fitted = scale * (nominal * flat) @ R.T + shift
    turn = Rotation.from_matrix(R).as_rotvec()
    return RigidDrift(turn, shift, scale - 1, (position - fitted)[..., :dims])


class CheckedRecording:
    """Grids and markers in space of all frames."""

    def __init__(
        self,
        sensor: SensorDescription,
        grids: Mapping[str, Sequence[Grid]],
        limits: CheckParameters,
    ) -> None:
        self.sensor, self.grids, self.limits = sensor, grids, limits
        self.nominal = sensor.pattern.corners()
        rig = observation.rig_for_any_gap(sensor)
        self.views: dict[str, ViewGeometry] = rig.views
        nothing = [None] * len(next(iter(grids.values())))
        pairs = zip(grids.get("left", nothing), grids.get("right", nothing), strict=True)
        markers = [rig.triangulate(left, right) for left, right in pairs]
        measured = np.stack([item.status == Status.MEASURED for item in markers])
        position = np.stack([item.position for item in markers])
        self.positions = np.where(measured[..., None], position, np.nan)
        self.gaps = np.where(measured, np.stack([item.ray_gap for item in markers]), np.nan)
        self.tracked = float(measured.mean())

    @property
    def two_views(self) -> bool:
        """Whether the views can be held against one another."""
        return len(self.views) == 2

    def pixels(self, view: str) -> NDArray[np.float64]:
        """Corners of all frames, (F, rows, cols, 2) px of the view."""
        return np.stack([grid.corners for grid in self.grids[view]])

    def rest(self) -> NDArray[np.intp]:
        """Numbers of the frames that show the gel at rest.

        At rest for two frames at least: in between a gel passes its rest shape as well.  Of fewer
        than three frames, whose noise is unknown, the shape alone decides.
        """
        limit = motion_limit(self.positions)
        steps = [largest_motion(*both) for both in pairwise(self.positions)]
        quiet = np.array(steps) <= limit
        still = np.append(quiet, False) | np.insert(quiet, 0, False) | (len(self.positions) < 3)
        shapes = [rest_shape(self.nominal, position) for position in self.positions]
        alike = [shape is not None and shape.bump <= self.limits.rest_shape for shape in shapes]
        return np.flatnonzero(still & alike)

    def drift(self, rest: NDArray[np.intp]) -> RigidDrift | None:
        """Motion of the gel at rest against the description."""
        if not len(rest):
            return None
        known = np.isfinite(self.positions[rest][..., 0]).sum(axis=0)
        total = np.nansum(self.positions[rest], axis=0)
        mean = np.where((known > 0)[..., None], total / np.maximum(known, 1)[..., None], np.nan)
        if not self.two_views:
            mean[..., 2] = np.nan
        return rigid_drift(mean, self.nominal)

    def residuals(self, rest: NDArray[np.intp]) -> tuple[outcome.ViewResiduals, ...]:
        """Measured pixels minus the projection of the markers' points."""
        found = []
        for name, view in self.views.items():
            pixels = self.pixels(name)
            points = self.positions
            if not self.two_views:
                pixels = pixels[rest]
                points = np.broadcast_to(self.nominal, (*pixels.shape[:-1], 3))
            off = pixels - view.project(points)
            known = np.isfinite(off).all(axis=-1)
            numbers = rest if not self.two_views else np.arange(len(pixels))
            image = np.broadcast_to(numbers[:, None, None], known.shape)[known]
            used = np.ones(len(image), np.bool_)
            found.append(outcome.ViewResiduals(name, pixels[known], off[known], image, used))
        return tuple(found)

    def epipolar(self) -> NDArray[np.float64]:
        """Distance (K,) px of right pixels from the curves on which the left rays are seen."""
        known = np.isfinite(self.positions).all(axis=-1)
        points = self.positions[known]
        origins, directions = self.views["left"].rays(self.pixels("left")[known])
        along = ((points - origins) * directions).sum(axis=-1, keepdims=True)
        q, by_point = self.views["right"].project_with_jacobian(origins + along * directions)
        tangent = np.einsum("nij,nj->ni", by_point, directions)
        off = self.pixels("right")[known] - q
        across = off[:, 0] * tangent[:, 1] - off[:, 1] * tangent[:, 0]
        return np.asarray(np.abs(across) / np.linalg.norm(tangent, axis=-1))

    def rest_reprojection(self, rest: NDArray[np.intp]) -> float:
        """RMS distance, px, of the corners at rest from the projection of the nominal ones."""
        usable = np.isin(np.arange(len(self.positions)), rest)
        off = [
            observation.observed(name, self.grids[name], usable).corners
            - view.project(self.nominal)
            for name, view in self.views.items()
        ]
        lengths2 = (np.stack(off) ** 2).sum(axis=-1)
        return float(np.sqrt(np.nanmean(lengths2)))


@dataclass(frozen=True)
class CheckFigure:
    """One figure and its limit, in `unit`.

    value: what is held against the limit; at_least: whether it must reach it, instead of staying
    below.  median, p95, maximum: over markers and frames; NaN for a single number.
    advice: what to do where it is out of its limit.
    """

    name: str
    unit: str
    value: float
    limit: float
    advice: str
    at_least: bool = False
    median: float = float("nan")
    p95: float = float("nan")
    maximum: float = float("nan")

    @property
    def kept(self) -> bool:
        """Whether the limit is kept."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True)
class CheckReport(outcome.WithFindings):
    """What the check of a recording found.

    frames: how many there are; rest_frames: indices of those of the gel at rest, from which drift
    is measured.  residuals: of the reprojection, all frames, by view; of the known surface at rest
    for one view.  drift: motion of the gel at rest against the description, None without such
    frames.
    """

    sensor: SensorDescription
    frames: int
    rest_frames: tuple[int, ...]
    figures: tuple[CheckFigure, ...]
    residuals: tuple[outcome.ViewResiduals, ...]
    drift: RigidDrift | None
    findings: tuple[Finding, ...]
    verdict: str


def check_recording(
    sensor: SensorDescription,
    frames: Sequence[NDArray[np.uint8]],
    on_progress: OnProgress = no_progress,
    limits: CheckParameters | None = None,
) -> CheckReport:
    """Check the calibration of a sensor on frames, (H, W) grey or (H, W, 3) BGR uint8.

    Raises CalibrationError without frames or where none shows the pattern, FrameError that names a
    frame of another size.
    """
    return check_grids(sensor, observation.track_frames(sensor, frames, on_progress), limits)


def check_grids(
    sensor: SensorDescription,
    grids: Mapping[str, Sequence[Grid]],
    limits: CheckParameters | None = None,
) -> CheckReport:
    """`check_recording` of what a tracker found: grids of the same frames, by view.

    Raises CalibrationError where none shows the pattern, and for grids of other views than the
    sensor's, of another shape, or not as many of each.
    """
    limits = limits or CheckParameters()
    observation.require_grids(sensor, grids)
    seen = CheckedRecording(sensor, grids, limits)
    if not np.isfinite(seen.positions[..., 0]).any():
        complaints = "; ".join(
            f"{name}: {observation.usual_complaint(view)}" for name, view in grids.items()
        )
        msg = (
            f"{sensor.name}: found no marker in any of {len(seen.positions)} frames ({complaints})"
        )
        raise CalibrationError(msg)
    rest = seen.rest()
    drift = seen.drift(rest)
    residuals = seen.residuals(rest)
    figures = (
        *_agreement_figures(seen, residuals, limits),
        *_rest_figures(seen, rest, drift, limits),
    )
    findings = _findings(sensor, figures, rest)
    return CheckReport(
        sensor=sensor,
        frames=len(seen.positions),
        rest_frames=tuple(int(number) for number in rest),
        figures=figures,
        residuals=residuals,
        drift=drift,
        findings=findings,
        verdict=_verdict(figures, findings),
    )


def _agreement_figures(
    seen: CheckedRecording, residuals: Sequence[outcome.ViewResiduals], limits: CheckParameters
) -> list[CheckFigure]:
    """Do the views agree?"""
    tracked = CheckFigure(
        name="markers measured",
        unit="",
        value=seen.tracked,
        limit=limits.tracked,
        advice="Check light and focus, and whether dirt or an object hides the pattern.",
        at_least=True,
    )
    if not seen.two_views:
        return [tracked]
    lengths = [np.linalg.norm(item.residuals, axis=-1) for item in residuals]
    recalibrate = (
        "A mirror or the camera has moved, or this is the description of another sensor: "
        "calibrate again from frames of the gel at rest."
    )
    return [
        _spread("reprojection", "px", np.concatenate(lengths), limits.reprojection, recalibrate),
        _spread("epipolar error", "px", seen.epipolar(), limits.epipolar, recalibrate),
        _spread("ray gap", "m", seen.gaps[np.isfinite(seen.gaps)], limits.ray_gap, recalibrate),
        tracked,
    ]


def _spread(
    name: str, unit: str, values: NDArray[np.float64], limit: float, advice: str
) -> CheckFigure:
    median, p95, most = (float(v) for v in np.percentile(values, [50, JUDGED_PERCENT, 100]))
    return CheckFigure(name, unit, p95, limit, advice, median=median, p95=p95, maximum=most)


def _rest_figures(
    seen: CheckedRecording,
    rest: NDArray[np.intp],
    drift: RigidDrift | None,
    limits: CheckParameters,
) -> list[CheckFigure]:
    """Is the gel at rest where the description has it?"""
    if drift is None:
        return []
    moved = (
        "The gel or a mirror has moved since the calibration, for example at remounting: "
        "calibrate again from frames of the gel at rest."
    )
    bent = (
        "Check that the gel is at rest. If it is, the gel is worn or was replaced: check pattern "
        "and surface in the description, and calibrate again."
    )
    record = seen.sensor.calibration
    promised = record.reprojection if record is not None else 0.0
    return [
        CheckFigure(
            "corners at rest",
            "px",
            seen.rest_reprojection(rest),
            max(limits.rest_reprojection, 3 * promised),
            moved,
        ),
        CheckFigure("turn", "rad", float(np.linalg.norm(drift.turn)), limits.turn, moved),
        CheckFigure("shift", "m", float(np.linalg.norm(drift.shift)), limits.shift, moved),
        CheckFigure("growth", "", abs(drift.growth), limits.scale, moved),
        CheckFigure("shape at rest", "m", drift.shape_peak, limits.shape, bent),
    ]


def _findings(
    sensor: SensorDescription, figures: Sequence[CheckFigure], rest: NDArray[np.intp]
) -> tuple[Finding, ...]:
    findings = []
    for figure in figures:
        if figure.kept:
            continue
        wanted = "at least" if figure.at_least else "at most"
        whom = f" for {JUDGED_PERCENT:g} % of the markers" if np.isfinite(figure.p95) else ""
        value, limit = (outcome.value_text(v, figure.unit) for v in (figure.value, figure.limit))
        name = f"{figure.name[0].upper()}{figure.name[1:]}"
        text = f"{name}: found {value}{whom}, expected {wanted} {limit}."
        findings.append(Finding(Severity.ERROR, text, figure.advice))
    if not len(rest):
        findings.append(finding("no rest", error=len(sensor.views) != 2))
    return tuple(findings)


def _verdict(figures: Sequence[CheckFigure], findings: Sequence[Finding]) -> str:
    errors = errors_in(findings)
    if errors:
        return f"Do not measure with this calibration. {errors[0].text} {errors[0].advice}"
    listed = ", ".join(
        f"{figure.name} {outcome.value_text(figure.value, figure.unit)} (limit "
        f"{outcome.value_text(figure.limit, figure.unit)})"
        for figure in figures
    )
    unknown = " Drift is not known: no frame shows the gel at rest." if findings else ""
    return f"The calibration is good: {listed}.{unknown}"
