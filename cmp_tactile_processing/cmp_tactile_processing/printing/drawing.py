"""What is drawn on a sheet, whatever the file's format: ink, solids, lines and labels, in mm."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["LAYERS", "LINE_WIDTH", "Drawing", "Label", "Line"]

# Names of the layers; the ink's polygons lie on PATTERN, labels on TEXT.
LAYERS = ("PATTERN", "REGISTRATION", "OUTLINE", "CUT", "TEXT")
LINE_WIDTH = 0.1


@dataclass(frozen=True)
class Line:
    """A line through points (N, 2), closed or not, on REGISTRATION, OUTLINE or CUT."""

    points: NDArray[np.float64]
    layer: str
    closed: bool = False


@dataclass(frozen=True)
class Label:
    """Text in one line; place: of its base line; size: of the font, mm.

    anchor: start, middle or end, the part of the text that stands at the place.
    """

    text: str
    place: tuple[float, float]
    size: float
    anchor: str = "start"


@dataclass(frozen=True)
class Drawing:
    """Everything in mm, x to the right, y *down*, as on a page.

    ink: polygons (N, 2) of each copy of the pattern, filled by the even-odd and by the non-zero
    rule alike.  solids: filled polygons of the registration marks.
    """

    ink: tuple[tuple[NDArray[np.float64], ...], ...] = ()
    solids: tuple[NDArray[np.float64], ...] = ()
    lines: tuple[Line, ...] = ()
    labels: tuple[Label, ...] = ()

    def moved(self, by: tuple[float, float]) -> Drawing:
        """The same, by so much to the right and down."""
        step = np.array(by)
        return Drawing(
            ink=tuple(tuple(contour + step for contour in copy) for copy in self.ink),
            solids=tuple(contour + step for contour in self.solids),
            lines=tuple(Line(line.points + step, line.layer, line.closed) for line in self.lines),
            labels=tuple(
                Label(
                    label.text,
                    (label.place[0] + by[0], label.place[1] + by[1]),
                    label.size,
                    label.anchor,
                )
                for label in self.labels
            ),
        )

    @classmethod
    def together(cls, parts: Iterable[Drawing]) -> Drawing:
        """All in one."""
        drawings = tuple(parts)
        return cls(
            ink=tuple(copy for part in drawings for copy in part.ink),
            solids=tuple(contour for part in drawings for contour in part.solids),
            lines=tuple(line for part in drawings for line in part.lines),
            labels=tuple(label for part in drawings for label in part.labels),
        )
