"""What numbering says of a view: the corners by their numbers, and why some are missing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import GridFault

# Fewer corners that the fit cannot join to the rest are the rim of something that hides the gel.
FEWEST_STRAYS = 6
# Corners with this share of the grid's that fit nowhere are another pattern.
OTHER_PATTERN = 0.1
# Factor of the confidence where components were joined across a gap.
JOINED_CONFIDENCE = 0.9


@dataclass(frozen=True)
class Numbering:
    """corners (rows, cols, 2) px, NaN where missing; reason, fault: why some are, else empty.

    confidence: 1 for a complete grid that was seen to end on all four sides and fits the nominal
    projection; each missing piece of evidence takes a fixed share.  It orders numberings by their
    evidence and is not a measured probability.  0.5 and less: rows or columns rest on one
    border alone.  0 where nothing is numbered.
    between: the image rows between which the corners lie, px; beyond them the image is torn.
    by_code: whether the pattern's dots show the numbers, wherever it ends.
    """

    corners: NDArray[np.float64]
    reason: str
    fault: GridFault = GridFault.NONE
    confidence: float = 0.0
    between: tuple[float, float] = (-np.inf, np.inf)
    by_code: bool = False

    @classmethod
    def nothing(cls, shape: tuple[int, ...], fault: GridFault, reason: str) -> Numbering:
        """That of a grid (rows, cols) of which no corner has a number."""
        return cls(np.full((*shape, 2), np.nan), reason, fault)


def not_seen(missing: int) -> str:
    """The reason of a grid that lacks so many corners."""
    return f"{missing} corner{'s' if missing != 1 else ''} not seen"


def without_strays(numbering: Numbering, strays: int, missing: int) -> Numbering:
    """What is to be said where so many numbered corners turned out to be another pattern's.

    missing: corners without a position in the end.
    """
    if strays < FEWEST_STRAYS or numbering.fault is GridFault.TWO_PATTERNS:
        return numbering
    reason = (
        f"{not_seen(missing)}, and {strays} corners that do not continue the others: "
        "another pattern, or pieces of this one beside an object that hides the rest"
    )
    return replace(numbering, reason=reason, fault=GridFault.TWO_PATTERNS)
