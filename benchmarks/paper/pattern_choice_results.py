"""The sweep's results by pattern and camera, and what can be read from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.experiment import Results, number
from paper.pattern_choice import STANDARD_POINTS
from paper.pattern_choice_fields import FIELDS
from paper.pattern_choice_rig import CONDITIONS

__all__ = [
    "Cell",
    "best_pattern",
    "by_width",
    "cells_of",
    "coarsest_that_works",
    "errors_at",
    "excess",
    "nearest_to",
    "works_down_to",
]

LIGHTS = tuple(CONDITIONS)
BEADS = FIELDS.index("beads")
SMOOTH = [FIELDS.index("press"), FIELDS.index("shear")]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cell:
    """One pattern before one camera.  Arrays by condition are in the order of CONDITIONS.

    field: by virtual markers in a segment, (conditions, FIELDS) m; gain, seconds likewise.
    """

    rig: str
    width: int
    corners: int
    side_least: float
    side_mean: float
    visible: Array
    lost: Array
    wrong: Array
    marker: Array
    field: Mapping[int, Array]
    gain: Mapping[int, Array]
    seconds: Mapping[int, float]

    def fine(self, light: str = "good", points: int = STANDARD_POINTS) -> float:
        """RMS error of the field among beads, m."""
        return float(self.field[points][LIGHTS.index(light), BEADS])

    def smooth(self, light: str = "good", points: int = STANDARD_POINTS) -> float:
        """The same of a sphere that presses and one that drags, m: mean of squares."""
        errors = self.field[points][LIGHTS.index(light), SMOOTH]
        return float(np.sqrt((errors**2).mean()))

    def lost_share(self, light: str) -> float:
        """Share of visible markers without a place; 1 where the pattern is refused."""
        at = LIGHTS.index(light)
        if not self.visible[at] or np.isnan(self.lost[at]):
            return 1.0
        return float(self.lost[at] / self.visible[at])

    def works(self, light: str) -> bool:
        """Every marker has a place, and none another's number."""
        return self.lost_share(light) == 0 and self.wrong[LIGHTS.index(light)] == 0


def cells_of(results: Results, rig: str) -> list[Cell]:
    """All cells of a rig, by width and number of corners."""
    cells = []
    for name, arrays in results.items():
        if not name.startswith(f"{rig}-"):
            continue
        points = [int(count) for count in arrays["points"]]
        for k, corners in enumerate(arrays["corners"]):
            each = {count: p for p, count in enumerate(points)}
            cells.append(
                Cell(
                    rig=rig,
                    width=int(number(arrays, "width")),
                    corners=int(corners),
                    side_least=float(arrays["side_least"][k]),
                    side_mean=float(arrays["side_mean"][k]),
                    visible=arrays["visible"][k],
                    lost=arrays["lost"][k],
                    wrong=arrays["wrong"][k],
                    marker=arrays["marker"][k],
                    field={count: arrays["field"][k, p] for count, p in each.items()},
                    gain={count: arrays["gain"][k, p] for count, p in each.items()},
                    seconds={count: float(arrays["seconds"][k, p]) for count, p in each.items()},
                )
            )
    return sorted(cells, key=lambda cell: (cell.width, cell.corners))


def works_down_to(cells: Sequence[Cell], light: str, start: float) -> float:
    """The smallest side, px, down to which every pattern works, from those next above `start` on.

    NaN where that one does not work itself.
    """
    ordered = sorted(cells, key=lambda cell: -cell.side_least)
    least = min((cell.side_least for cell in cells if cell.side_least >= start), default=np.nan)
    reached = float("nan")
    for cell in ordered:
        if cell.side_least > least:
            continue
        if not cell.works(light):
            break
        reached = cell.side_least
    return reached


def coarsest_that_works(cells: Sequence[Cell], start: float) -> Cell | None:
    """The pattern of fewest corners up to which, from sides of `start` px on, all work in good
    light.
    """
    found = None
    for cell in sorted(cells, key=lambda cell: cell.side_least):
        if cell.side_least < start:
            continue
        if not cell.works("good"):
            break
        found = cell
    return found


def best_pattern(cells: Sequence[Cell], light: str = "good") -> Cell:
    """The pattern whose errors, fine and smooth alike, are least: the product of both is."""
    return min(cells, key=lambda cell: _product(cell, light))


def errors_at(cells: Sequence[Cell], side: float, light: str = "good") -> tuple[float, float]:
    """Fine and smooth errors, m, of one camera with checkers of `side` px at their smallest.

    Between two patterns by logarithms; NaN beyond the outermost whose errors are known.
    """
    known = sorted(
        (np.log(cell.side_least), np.log(cell.fine(light)), np.log(cell.smooth(light)))
        for cell in cells
        if np.isfinite(_product(cell, light))
    )
    if not known:
        return float("nan"), float("nan")
    sides, *errors = np.array(known).T
    fine, smooth = (
        float(np.exp(np.interp(np.log(side), sides, error, np.nan, np.nan))) for error in errors
    )
    return fine, smooth


def excess(cells: Sequence[Cell], side: float, light: str = "good") -> float:
    """Errors with checkers of `side` px over those with the best pattern."""
    fine, smooth = errors_at(cells, side, light)
    return float(np.sqrt(fine * smooth / _product(best_pattern(cells, light), light)))


def nearest_to(cells: Sequence[Cell], side: float) -> Cell:
    """The pattern whose least side comes nearest to `side` px, as a ratio."""
    return min(cells, key=lambda cell: abs(np.log(cell.side_least / side)))


def by_width(cells: Sequence[Cell]) -> dict[int, list[Cell]]:
    """Patterns of each camera."""
    widths = sorted({cell.width for cell in cells})
    return {width: [cell for cell in cells if cell.width == width] for width in widths}


def _product(cell: Cell, light: str) -> float:
    product = cell.fine(light) * cell.smooth(light)
    return product if np.isfinite(product) else float("inf")
