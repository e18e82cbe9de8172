"""What is wrong with a print, in numbers of the grid, so that it holds however the gel moves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Defect", "DefectKind", "PrintDefects"]

# So many defects are named one by one in a report.
NAMED = 5


class DefectKind(str, Enum):
    """What kind of flaw it is."""

    MISSING_INK = "missing_ink"
    DIRT = "dirt"
    RAGGED_EDGE = "ragged_edge"


@dataclass(frozen=True)
class Defect:
    """A flaw of the print.

    row, col: its centre in grid numbers, corner (i, j) at (i, j); on the outermost checkers they
    are below 0 or beyond the last number.  centre_px (2,): in the view image that was inspected.
    extent_px: diameter of the disc of its area, or of a ragged edge the length.
    strength: a spot's peak as a share of the contrast between ink and skin; of a ragged edge the
    rms by which it strays, px.
    """

    kind: DefectKind
    row: float
    col: float
    centre_px: NDArray[np.float64]
    extent_px: float
    strength: float

    @property
    def cell(self) -> tuple[int, int]:
        """The checker (i, j) that it is on, between corners (i, j) and (i + 1, j + 1)."""
        return int(np.floor(self.row)), int(np.floor(self.col))


@dataclass(frozen=True)
class PrintDefects:
    """The state of a print.

    corner_weight (rows, cols): 1 for a sound corner, 0 for one that is destroyed; its standard
    deviation divided by this is what it is worth.
    row_line_doubtful (rows, cols-1, n), col_line_doubtful (rows-1, cols, n): virtual markers so
    close to a spot, or so far astray, that they are better predicted than measured.
    row_raggedness (rows, cols-1), col_raggedness (rows-1, cols): rms by which the printed edge
    strays from its smooth curve in each segment, noise taken off, px; NaN where not measured.
    raggedness_px: the same over all segments.
    judged: share of the print that could be inspected, 0 to 1; what was not counts as sound.
    frames: number of frames averaged.
    """

    corner_weight: NDArray[np.float64]
    row_line_doubtful: NDArray[np.bool_]
    col_line_doubtful: NDArray[np.bool_]
    row_raggedness: NDArray[np.float64]
    col_raggedness: NDArray[np.float64]
    raggedness_px: float
    defects: Sequence[Defect]
    judged: float
    frames: int

    @property
    def report(self) -> str:
        """The state of the print in one paragraph."""
        counts = Counter(defect.kind for defect in self.defects)
        found = ", ".join(
            f"{counts[kind]} {name if counts[kind] == 1 else plural}"
            for kind, name, plural in (
                (DefectKind.MISSING_INK, "spot without ink", "spots without ink"),
                (DefectKind.DIRT, "spot of dirt or excess ink", "spots of dirt or excess ink"),
                (DefectKind.RAGGED_EDGE, "ragged edge", "ragged edges"),
            )
            if counts[kind]
        )
        frames = f"{self.frames} frame{'s' if self.frames != 1 else ''}"
        text = f"Print, {self.judged:.0%} of it inspected in {frames}: {found or 'no defects'}."
        largest = sorted(self.defects, key=lambda defect: -defect.extent_px)[:NAMED]
        spots = [item for item in largest if item.kind is not DefectKind.RAGGED_EDGE]
        if spots:
            named = "; ".join(
                f"{spot.kind.value.replace('_', ' ')} at row {spot.row:.1f}, column {spot.col:.1f} "
                f"({spot.extent_px:.1f} px)"
                for spot in spots
            )
            text += f" Largest: {named}."
        if np.isfinite(self.raggedness_px):
            text += f" Edges stray by {self.raggedness_px:.2f} px rms."
        destroyed = int(np.count_nonzero(self.corner_weight == 0))
        weakened = int(np.count_nonzero(self.corner_weight < 1)) - destroyed
        doubtful = int(self.row_line_doubtful.sum() + self.col_line_doubtful.sum())
        if destroyed or weakened or doubtful:
            text += (
                f" {destroyed} corners are destroyed, {weakened} weakened; "
                f"{doubtful} virtual markers are doubtful."
            )
        return text
