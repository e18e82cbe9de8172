"""Grids of a recording: arrays of one frame, and what was wrong with those of all frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid, GridFault

__all__ = ["GridFaults", "grid_arrays"]

# Longest name of a fault: an array of texts has one length.
FAULT_TYPE = f"U{max(len(fault.value) for fault in GridFault)}"


def grid_arrays(grid: Grid) -> dict[str, NDArray[Any]]:
    """Everything that a grid tells, by name; what it came without is NaN."""
    return {
        "corners": grid.corners,
        "corner_status": grid.corner_status,
        "corner_std": _known(grid.corner_std, grid.corner_status),
        "row_lines": grid.row_lines,
        "row_line_status": grid.row_line_status,
        "row_line_std": _known(grid.row_line_std, grid.row_line_status),
        "col_lines": grid.col_lines,
        "col_line_status": grid.col_line_status,
        "col_line_std": _known(grid.col_line_std, grid.col_line_status),
        "confidence": np.array(grid.confidence, np.float64),
        "followed": np.array(grid.followed),
        "fault": np.array(grid.fault.value, FAULT_TYPE),
    }


def _known(values: NDArray[np.float64] | None, status: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.full(status.shape, np.nan) if values is None else values


class GridFaults:
    """Counts the frames of a recording in which a view's pattern was not found."""

    def __init__(self) -> None:
        self._frames = self._frames_with_fault = 0
        self._faulty: dict[str, int] = {}
        self._last: dict[str, str] = {}

    def add(self, grids: dict[str, Grid | None]) -> None:
        """Take the grids of a frame, by view, into account."""
        self._frames += 1
        before = sum(self._faulty.values())
        for view, grid in grids.items():
            # Parts of the pattern may be hidden at any time.
            if grid is not None and grid.fault not in (GridFault.NONE, GridFault.PARTLY_HIDDEN):
                self._faulty[view] = self._faulty.get(view, 0) + 1
                self._last[view] = f"{grid.fault.value}: {grid.reason}"
        self._frames_with_fault += sum(self._faulty.values()) > before

    @property
    def problem(self) -> str:
        """That all frames have a fault, and how many these are; empty where one has none."""
        if not self._frames or self._frames_with_fault < self._frames:
            return ""
        return f"all {self._frames} frames have a fault: {'; '.join(self.doubts)}"

    @property
    def doubts(self) -> Iterator[str]:
        """A line for each view with faults."""
        for view, count in self._faulty.items():
            yield f"{view} view: in {count} of {self._frames} frames {self._last[view]}"
