"""What the grids of the last second say of the sensor, for the tracker's diagnostics."""

from __future__ import annotations

import math

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.measured.grid import Grid, GridFault

__all__ = ["FAULT_LEVELS", "GridHealth"]

FAULT_LEVELS: dict[GridFault, bytes] = {
    # A hand in front of the gel, or a finger in it: what it is made for.
    GridFault.NONE: DiagnosticStatus.OK,
    GridFault.PARTLY_HIDDEN: DiagnosticStatus.OK,
    # Light, dirt or something in the way.
    GridFault.DARK: DiagnosticStatus.WARN,
    GridFault.OVEREXPOSED: DiagnosticStatus.WARN,
    GridFault.NO_CONTRAST: DiagnosticStatus.WARN,
    GridFault.NO_PATTERN: DiagnosticStatus.WARN,
    GridFault.TWO_PATTERNS: DiagnosticStatus.WARN,
    GridFault.AMBIGUOUS: DiagnosticStatus.WARN,
    # The sensor description is not that of this sensor: it does not pass by itself.
    GridFault.OTHER_SIZE: DiagnosticStatus.ERROR,
    GridFault.MIRRORED: DiagnosticStatus.ERROR,
    GridFault.TURNED: DiagnosticStatus.ERROR,
    GridFault.OTHER_COLOURS: DiagnosticStatus.ERROR,
}


class GridHealth:
    """Gathers grids; `close_period` tells of those that came since the last call."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._grids = 0
        self._followed = 0
        self._confidence = math.nan
        self._found = math.nan
        self._worst = GridFault.NONE
        self._reason = ""
        self._faulty = 0

    def add(self, grid: Grid) -> None:
        """Take a grid into account."""
        self._grids += 1
        self._followed += grid.followed
        self._found = grid.found_fraction
        self._confidence = min(grid.confidence, self._confidence, key=_nan_last)
        self._faulty += grid.fault is not GridFault.NONE
        if FAULT_LEVELS[grid.fault] >= FAULT_LEVELS[self._worst] and grid.reason:
            self._worst, self._reason = grid.fault, grid.reason

    def close_period(self) -> tuple[bytes, str, dict[str, str]]:
        """Level, text and figures of the period: the worst fault and the least confidence.

        The text is empty where nothing was missing; figures of no grid are nan.
        """
        followed = self._followed / self._grids if self._grids else math.nan
        figures = {
            "tracked fraction": f"{self._found:.4f}",
            "confidence": f"{self._confidence:.3f}",
            "followed": f"{followed:.2f}",
            "fault": self._worst.value,
            "frames with a fault": f"{self._faulty} of {self._grids}",
        }
        level, text = FAULT_LEVELS[self._worst], self._reason
        self._begin()
        return level, text, figures


def _nan_last(value: float) -> float:
    return math.inf if math.isnan(value) else value
