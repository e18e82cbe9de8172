"""How far a sensor's description is from the truth, on frames of which that is recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings import library
from cmp_tactile_bringup.report.results import TableRow
from cmp_tactile_processing.calibration.check import CheckedRecording, CheckParameters
from cmp_tactile_processing.calibration.outcome import length_text
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.errors import OutputError
from cmp_tactile_simulation.recording.truth import RecordedTruth, read_truth

# A gel is at rest while its markers are truly this near to their places at rest, m.
AT_REST = 1e-6


# Limits of the mean distances, um, and of the displacement's in percent of the largest.
POSITION_LIMIT_UM = DISPLACEMENT_LIMIT_UM = 5.0
DISPLACEMENT_LIMIT_PERCENT = 1.0


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
        """Mean distances with their limits."""
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

    grids: of the frames with these stamps, by view.  Raises RecordingError where the truth is of
    another pattern or of other frames, or no marker is seen.
    """
    numbers = {int(stamp): k for k, stamp in enumerate(truth.stamp_ns)}
    shape = sensor.pattern.shape.corners
    if truth.corners_m.shape[1:3] != shape:
        msg = f"truth: found {truth.corners_m.shape[1:3]} corners, expected {shape}"
        raise library.RecordingError(msg)
    unknown = [stamp for stamp in stamps_ns if stamp not in numbers]
    if unknown:
        msg = f"truth: found no frame with the stamp {unknown[0]} ns, expected one"
        raise library.RecordingError(msg)
    found = CheckedRecording(sensor, grids, CheckParameters()).positions
    true = truth.corners_m[[numbers[stamp] for stamp in stamps_ns]]
    return _compared(found, true, sensor.pattern.corners())


def _compared(
    found: NDArray[np.float64], true: NDArray[np.float64], nominal: NDArray[np.float64]
) -> TruthErrors:
    off = np.linalg.norm(found - true, axis=-1)
    if not np.isfinite(off).any():
        msg = "truth: found no marker in 3-D, expected the pattern of this sensor"
        raise library.RecordingError(msg)
    moved = np.linalg.norm(true - nominal, axis=-1)
    still = np.nanmax(moved.reshape(len(moved), -1), axis=1) < AT_REST
    displacement = np.full_like(off, np.nan)
    if still.any():
        zero, true_zero = np.nanmean(found[still], axis=0), np.nanmean(true[still], axis=0)
        displacement = np.linalg.norm((found - zero) - (true - true_zero), axis=-1)
    return TruthErrors(off, displacement, float(np.nanmax(moved)))
