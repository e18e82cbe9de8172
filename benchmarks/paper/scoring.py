"""How far a measurement is off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_simulation.hard_frames.grid_score import GridScore, join_scores, score_grid

__all__ = ["MarkerScore", "displacement_error", "position_error", "score_markers"]


@dataclass(frozen=True)
class MarkerScore:
    """visible: markers that both views show, summed over the views.

    found: measured with the right number.  wrong: with the number of another marker, or more than
    half a pitch off.
    """

    visible: int
    found: int
    wrong: int

    @property
    def works(self) -> bool:
        """Every visible marker found, none wrong."""
        return self.found == self.visible and self.wrong == 0


def score_markers(grids: Mapping[str, Grid], truth: Mapping[str, Grid]) -> MarkerScore:
    """Count markers of both views that are found and that bear wrong numbers."""
    score = join_scores(_score(grids[name], truth[name]) for name in truth)
    return MarkerScore(score.visible, score.found_visible, score.wrong)


def position_error(surface: Surface, truth: Surface) -> NDArray[np.float64]:
    """Measured minus true position (rows, cols, 3), m; NaN where missing."""
    return np.asarray(surface.position - truth.position)


def displacement_error(surface: Surface, truth: Surface) -> NDArray[np.float64]:
    """Measured minus true displacement from rest (rows, cols, 3), m; NaN where missing."""
    return np.asarray(surface.displacement - truth.displacement)


def _score(grid: Grid, truth: Grid) -> GridScore:
    visible = np.isfinite(truth.corners[..., 0])
    return score_grid(grid, truth, visible, visible)
