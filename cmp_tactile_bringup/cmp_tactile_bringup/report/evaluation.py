"""The results of a played recording against the truth, and the table of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings import library
from cmp_tactile_bringup.report.results import DemoResults, TableRow
from cmp_tactile_processing.calibration.check import CheckedRecording, CheckParameters
from cmp_tactile_processing.calibration.outcome import length_text
from cmp_tactile_processing.errors import FrameSourceError, OutputError
from cmp_tactile_processing.force.advice import ADVICE, flag_names, single_flags
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording.truth import RecordedTruth, read_truth

NAMED_FRAMES = 5
COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
# Standard deviations to either side of a value within which 95 % of the truth would lie.
BAND = 2.0
# A gel is at rest while its markers are truly this near to their places at rest, m.
AT_REST = 1e-6
# Limits of the mean distances, um, and of the displacement's in percent of the largest.
POSITION_LIMIT_UM = DISPLACEMENT_LIMIT_UM = 5.0
DISPLACEMENT_LIMIT_PERCENT = 1.0


@dataclass(frozen=True)
class Limits:
    """What a run must reach; the only home of these figures."""

    frames_lost: int = 0
    corners_not_found: int = 0
    corners_misnumbered: int = 0
    corner_rmse_px: float = 0.05
    position_mean_um: float = 10.0
    normal_force_percent: float = 3.0


LIMITS = Limits()


@dataclass(frozen=True)
class Evaluation:
    """Errors over all frames that came through.

    lost_frames: numbers of the frames that did not come through every stage.
    corner_*: distance of measured corners to the truth, both views, px of the frame; misnumbered
    ones count with the distance to the corner that has their number.
    position_*, displacement_*: distance of markers to the truth in 3-D, um; the displacement is
    taken against the truth of the recording's first frame.
    """

    frames_in: int
    lost_frames: tuple[int, ...]
    corners_expected: int
    corners_found: int
    corners_misnumbered: int
    corner_rmse_px: float
    corner_p99_px: float
    corner_max_px: float
    markers_expected: int
    markers_found: int
    position_mean_um: float
    displacement_mean_um: float
    force: ForceEvaluation


def evaluate(results: DemoResults) -> Evaluation:
    """Compare every frame with the truth; an error is NaN where no frame came through."""
    truth, frames = results.recording.truth, results.frames
    rows, cols = truth.corners_m.shape[1:3]
    index = np.array([frame.index for frame in frames], np.intp)
    grids = [grid for frame in frames for grid in (frame.left, frame.right)]
    status = np.array([grid.corner_status for grid in grids]).reshape(-1, 2, rows, cols)
    q = np.array([grid.corners_frame for grid in grids]).reshape(-1, 2, rows, cols, 2)
    q_true = np.stack([truth.corners_left_px[index], truth.corners_right_px[index]], axis=1)
    p = np.array([frame.surface.position for frame in frames]).reshape(-1, rows, cols, 3)
    u = np.array([frame.surface.displacement for frame in frames]).reshape(p.shape)
    p_true = truth.corners_m[index]
    found = status == Status.MEASURED
    q_found = np.linalg.norm(q - q_true, axis=-1)[found]
    q_errors = _known(q_found)
    p_errors = _known(np.linalg.norm(p - p_true, axis=-1) * 1e6)
    u_errors = _known(np.linalg.norm(u - (p_true - truth.corners_m[0]), axis=-1) * 1e6)
    return Evaluation(
        frames_in=len(truth.stamp_ns),
        lost_frames=tuple(sorted(set(range(len(truth.stamp_ns))) - set(index.tolist()))),
        corners_expected=_visible(truth.corners_left_px) + _visible(truth.corners_right_px),
        corners_found=int(found.sum()),
        corners_misnumbered=int((q_found > _half_checkers(q_true)[found]).sum()),
        corner_rmse_px=float(np.sqrt((q_errors**2).mean())),
        corner_p99_px=float(np.quantile(q_errors, 0.99)),
        corner_max_px=float(q_errors.max()),
        markers_expected=_visible(truth.corners_left_px + truth.corners_right_px),
        markers_found=int(np.isfinite(p_errors).sum()),
        position_mean_um=float(p_errors.mean()),
        displacement_mean_um=float(u_errors.mean()),
        force=_evaluate_force(results),
    )


def table_rows(results: DemoResults, evaluation: Evaluation) -> list[TableRow]:
    """The table that is printed and shown on the page."""
    sent = f"{results.run.frames_sent} of {evaluation.frames_in}"
    return [
        TableRow("Frames played", sent),
        *_count_rows(evaluation),
        *_error_rows(evaluation),
        *_force_rows(evaluation.force),
        *_run_rows(results),
    ]


def _count_rows(e: Evaluation) -> list[TableRow]:
    not_found = e.corners_expected - e.corners_found
    misnumbered = e.corners_misnumbered
    return [
        _lost_row(e.lost_frames),
        TableRow("Corners found", f"{e.corners_found} of {e.corners_expected}"),
        _checked("Corners not found", not_found, LIMITS.corners_not_found, ""),
        _checked("Corners wrongly numbered", misnumbered, LIMITS.corners_misnumbered, ""),
        TableRow("Markers in 3-D", f"{e.markers_found} of {e.markers_expected}"),
    ]


def _error_rows(e: Evaluation) -> list[TableRow]:
    return [
        _checked("Corner error, RMS", e.corner_rmse_px, LIMITS.corner_rmse_px, "px", ".4f"),
        TableRow("Corner error, 99 % below", f"{e.corner_p99_px:.4f} px"),
        TableRow("Corner error, largest", f"{e.corner_max_px:.4f} px"),
        _checked("3-D error, mean", e.position_mean_um, LIMITS.position_mean_um, "µm", ".2f"),
        TableRow("Displacement error, mean", f"{e.displacement_mean_um:.2f} µm"),
    ]


def _force_rows(force: ForceEvaluation) -> list[TableRow]:
    share, limit = force.normal_share * 1e2, LIMITS.normal_force_percent
    area = f"{force.area_rms * 1e6:.1f} mm², of up to {force.area_peak * 1e6:.1f}"
    flags = ", ".join(f"{name} in {count}" for name, count in force.flagged.items())
    return [
        *(_component_row(force, number, name) for number, name in enumerate(COMPONENTS)),
        _checked("Fz error, RMS, of the largest Fz", share, limit, "%", ".1f"),
        TableRow("Contact area error, RMS", area),
        TableRow("Flags set, frames", flags or "none"),
    ]


def _component_row(force: ForceEvaluation, number: int, name: str) -> TableRow:
    scale, unit = (1.0, "N") if name.startswith("F") else (1e3, "N mm")
    rms, peak = force.wrench_rms[number] * scale, force.wrench_peak[number] * scale
    share, known = force.wrench_inside[number], force.wrench_known[number]
    inside = f"within ±{BAND:g} std in {share:.0%} of {known} frames" if known else "no error bars"
    return TableRow(f"{name} error, RMS", f"{rms:.4f} {unit}, of up to {peak:.3f}; {inside}")


def _run_rows(results: DemoResults) -> list[TableRow]:
    run = results.run
    rows = [TableRow(topic, f"{count} frames") for topic, count in run.received.items()]
    if np.isfinite(run.rate_hz):
        rows.append(TableRow("Rate", f"{run.rate_hz:.2f} Hz, requested {run.asked_hz:g} Hz"))
    # The grids are measured before the wrench; their messages are larger and may arrive later.
    latencies = {
        "wrench": (run.wrench_latency_s, ""),
        "grids": (run.grid_latency_s, "; to the arrival of both, larger messages than the wrench"),
    }
    for name, (latency_s, note) in latencies.items():
        if latency_s.size:
            median, p99 = np.quantile(latency_s * 1e3, [0.5, 0.99])
            value = f"{median:.1f} ms median, {p99:.1f} ms p99{note}"
            rows.append(TableRow(f"Latency, frame to {name}", value))
    rows += [TableRow(name, f"{seconds:.2f} s") for name, seconds in run.stages_s.items()]
    return rows


def _checked(name: str, value: float, limit: float, unit: str, form: str = "d") -> TableRow:
    # Written so that NaN, the value where nothing came through, does not pass.
    passed = bool(value <= limit)
    return TableRow(name, f"{value:{form}} {unit}".strip(), f"≤ {limit} {unit}".strip(), passed)


def _lost_row(lost: tuple[int, ...]) -> TableRow:
    row = _checked("Frames lost", len(lost), LIMITS.frames_lost, "")
    named = ", ".join(str(index) for index in lost[:NAMED_FRAMES])
    more = ", ..." if len(lost) > NAMED_FRAMES else ""
    return replace(row, value=f"{row.value} (numbers {named}{more})") if lost else row


def _half_checkers(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., rows, cols): half the distance of corners (..., rows, cols, 2) to the nearest other."""
    nearest = np.full(q.shape[:-1], np.inf)
    along_rows = np.linalg.norm(np.diff(q, axis=-2), axis=-1)
    along_cols = np.linalg.norm(np.diff(q, axis=-3), axis=-1)
    for part, distance in (
        (nearest[..., :-1], along_rows),
        (nearest[..., 1:], along_rows),
        (nearest[..., :-1, :], along_cols),
        (nearest[..., 1:, :], along_cols),
    ):
        np.minimum(part, distance, out=part)
    return nearest / 2


def _visible(corners_px: NDArray[np.float64]) -> int:
    """How many corners (n, rows, cols, 2) can be seen at all."""
    return int(np.isfinite(corners_px).all(axis=-1).sum())


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The finite ones (n,); one NaN where there is none."""
    finite = values[np.isfinite(values)]
    return finite if finite.size else np.array([np.nan])


@dataclass(frozen=True)
class ForceEvaluation:
    """Errors over all frames that came through, NaN where none did.

    wrench_rms (6,): of each component's error, N and N m, about the gel frame's origin.
    wrench_peak (6,): largest true size of each component in the recording.
    wrench_inside (6,): share of the frames with a true value within BAND standard deviations of
    the measured one, of those that came with a deviation; wrench_known (6,): how many did.
    area_rms, area_peak: as wrench_rms and wrench_peak, of the contact area, m^2.
    flagged: frames in which each flag was set, for those that were.
    """

    wrench_rms: NDArray[np.float64]
    wrench_peak: NDArray[np.float64]
    wrench_inside: NDArray[np.float64]
    wrench_known: NDArray[np.intp]
    area_rms: float
    area_peak: float
    flagged: Mapping[str, int]

    @property
    def normal_share(self) -> float:
        """RMS error of the normal force over its largest size."""
        return float(self.wrench_rms[2] / self.wrench_peak[2])


def _evaluate_force(results: DemoResults) -> ForceEvaluation:
    """Compare wrench and contact area of every frame with the truth."""
    truth = results.recording.truth
    frames = np.array([frame.index for frame in results.frames], np.intp)
    wrench = np.array([frame.force.wrench for frame in results.frames]).reshape(-1, 6)
    std = np.array([frame.force.random_std for frame in results.frames]).reshape(-1, 6)
    area = np.array([frame.force.contact_area for frame in results.frames])
    known = np.isfinite(wrench) & (std > 0)
    inside = known & (np.abs(wrench - truth.wrench[frames]) <= BAND * std)
    count = known.sum(axis=0)
    return ForceEvaluation(
        wrench_rms=_rms_of_each(wrench - truth.wrench[frames]),
        wrench_peak=np.abs(truth.wrench).max(axis=0),
        wrench_inside=np.where(count > 0, inside.sum(axis=0) / np.maximum(count, 1), np.nan),
        wrench_known=count,
        area_rms=float(_rms_of_each(area - truth.contact_area[frames])),
        area_peak=float(truth.contact_area.max()),
        flagged=_flagged(results),
    )


def _flagged(results: DemoResults) -> dict[str, int]:
    counts = Counter(flag for frame in results.frames for flag in single_flags(frame.force.flags))
    return {flag_names(flag): counts[flag] for flag in ADVICE if flag in counts}


def _rms_of_each(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Over the first axis; an error that is not known makes the whole not known."""
    if not len(errors):
        return np.full(errors.shape[1:], np.nan)
    return np.asarray(np.sqrt((errors**2).mean(axis=0)))


@dataclass(frozen=True)
class TruthErrors:
    """Distances (frames, rows, cols) m of the markers to the truth, NaN where one is missing.

    position: gel frame.  displacement: from the mean of the frames in which the gel is truly at
    rest; all NaN without such frames.  largest_displacement: true, m.
    """

    position: NDArray[np.float64]
    displacement: NDArray[np.float64]
    largest_displacement: float

    @property
    def kept(self) -> bool:
        """Whether all limits are kept."""
        return all(row.passed for row in self.rows())

    def rows(self) -> list[TableRow]:
        """Mean distances with their LIMITS."""
        mean = float(np.nanmean(self.position))
        far = float(np.nanpercentile(self.position, 99))
        rows = [
            TableRow(
                "3-D error against the truth: mean, 99 % below",
                f"{length_text(mean)}, {length_text(far)}",
                f"mean <= {POSITION_LIMIT_UM:g} um",
                mean * 1e6 <= POSITION_LIMIT_UM,
            )
        ]
        if np.isfinite(self.displacement).any():
            rows.append(self._displacement_row())
        return rows

    def _displacement_row(self) -> TableRow:
        mean = float(np.nanmean(self.displacement))
        percent = 100 * mean / max(self.largest_displacement, 1e-12)
        kept = mean * 1e6 <= DISPLACEMENT_LIMIT_UM
        limit = f"mean <= {DISPLACEMENT_LIMIT_UM:g} um"
        value = length_text(mean)
        if self.largest_displacement > DISPLACEMENT_LIMIT_UM * 1e-6:
            value += f", {percent:.2f} % of the largest, {self.largest_displacement * 1e3:.2f} mm"
            limit += f" and {DISPLACEMENT_LIMIT_PERCENT:g} %"
            kept &= percent <= DISPLACEMENT_LIMIT_PERCENT
        return TableRow("Displacement error against the truth", value, limit, kept)


def truth_of(source: Path) -> RecordedTruth | None:
    """What is true of a recording's frames; None where it is not recorded."""
    if not library.sensor_of_recording(str(source)):
        return None
    try:
        return read_truth(library.recorded_source(source))
    except OutputError:
        return None


def truth_errors(
    sensor: SensorDescription,
    grids: Mapping[str, Sequence[Grid]],
    stamps_ns: Sequence[int],
    truth: RecordedTruth,
) -> TruthErrors:
    """Errors of a sensor's description on frames of which the truth is known.

    grids: of the frames with these stamps, by view.  Raises FrameSourceError where the truth is of
    another pattern or of other frames, or no marker is seen.
    """
    numbers = {int(stamp): k for k, stamp in enumerate(truth.stamp_ns)}
    shape = sensor.pattern.shape.corners
    if truth.corners_m.shape[1:3] != shape:
        msg = f"truth: found {truth.corners_m.shape[1:3]} corners, expected {shape}"
        raise FrameSourceError(msg)
    unknown = [stamp for stamp in stamps_ns if stamp not in numbers]
    if unknown:
        msg = f"truth: found no frame with the stamp {unknown[0]} ns, expected one"
        raise FrameSourceError(msg)
    found = CheckedRecording(sensor, grids, CheckParameters()).positions
    true = truth.corners_m[[numbers[stamp] for stamp in stamps_ns]]
    return _compared(found, true, sensor.pattern.corners())


def _compared(
    found: NDArray[np.float64], true: NDArray[np.float64], nominal: NDArray[np.float64]
) -> TruthErrors:
    off = np.linalg.norm(found - true, axis=-1)
    if not np.isfinite(off).any():
        msg = "truth: found no marker in 3-D, expected the pattern of this sensor"
        raise FrameSourceError(msg)
    moved = np.linalg.norm(true - nominal, axis=-1)
    still = np.nanmax(moved.reshape(len(moved), -1), axis=1) < AT_REST
    displacement = np.full_like(off, np.nan)
    if still.any():
        zero, true_zero = np.nanmean(found[still], axis=0), np.nanmean(true[still], axis=0)
        displacement = np.linalg.norm((found - zero) - (true - true_zero), axis=-1)
    return TruthErrors(off, displacement, float(np.nanmax(moved)))
