"""Texts for RViz: a marker for each line, stacked along what is up for the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from cmp_tactile_processing.ros.rviz import drawing

# From a line of a text to the next, in letters.  Each line is a marker: within one, RViz adds 5 mm
# to each line, whatever the size.
LINE_STEP = 1.2
# Width of a letter in its height: what texts need that stand beside one another.
LETTER_WIDTH = 0.6
# Of up, the part in the gel's plane below which the gel lies flat.
LEAST_SLOPE = 0.05
FLAT = np.array([0.0, 1.0, 0.0])
OUTWARDS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Page:
    """The gel as a page that the viewer has before him; unit vectors (3,) of the gel frame.

    up: what is up for the viewer.  slope: the same in the gel's plane; y of a gel that lies flat,
    which has it up for who looks down on it.  right, top: the page's edges, along the gel's.
    """

    up: NDArray[np.float64]
    slope: NDArray[np.float64]
    right: NDArray[np.float64]
    top: NDArray[np.float64]

    @classmethod
    def of(cls, up: Sequence[float]) -> Page:
        """The page for an up of any length; that of the gel frame's z where it has none."""
        length = float(np.linalg.norm(up))
        unit = np.asarray(up, np.float64) / length if length > 0 else OUTWARDS
        flat = np.append(unit[:2], 0.0)
        steepness = float(np.linalg.norm(flat))
        slope = flat / steepness if steepness > LEAST_SLOPE else FLAT
        axis = int(np.argmax(np.abs(slope)))
        top = np.zeros(3)
        top[axis] = np.sign(slope[axis])
        return cls(unit, slope, np.cross(top, OUTWARDS), top)

    @property
    def stack(self) -> NDArray[np.float64]:
        """The way up from line to line: apart from above as well as from the side."""
        outwards: NDArray[np.float64] = self.up[2] * OUTWARDS
        return self.slope + outwards

    def height(self, points: NDArray[np.float64]) -> float:
        """How far up the slope points (..., 3) reach; -inf where none is known."""
        heights = points.reshape(-1, 3) @ self.slope
        known = heights[np.isfinite(heights)]
        return float(known.max()) if len(known) else -np.inf

    def extent(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The least and the greatest (right, top) of points (N, 3)."""
        across = points @ np.stack([self.right, self.top], axis=1)
        return across.min(axis=0), across.max(axis=0)

    def place(
        self, right: NDArray[np.float64] | float, top: NDArray[np.float64] | float, z: float
    ) -> NDArray[np.float64]:
        """The points (..., 3) at these places of the page."""
        flat = np.multiply.outer(right, self.right) + np.multiply.outer(top, self.top)
        return flat + z * OUTWARDS


def stacked(  # noqa: PLR0913, PLR0917 - what is written, where, how large
    namespace: str,
    first: int,
    place: NDArray[np.float64],
    lines: Sequence[tuple[str, drawing.RGBA]],
    size: float,
    page: Page,
) -> list[drawing.DrawnMarker]:
    """A marker for each line and its colour around a place (3,), numbered on from the top one.

    RViz takes half of scale.x for the width of a space, and some 0.7 m where that is 0.
    """
    below = LINE_STEP * size * (np.arange(len(lines)) - (len(lines) - 1) / 2)
    places = (place - below[:, None] * page.stack).tolist()
    return [
        drawing.DrawnMarker(
            namespace,
            Marker.TEXT_VIEW_FACING,
            first + number,
            colour=colour,
            scale=(size, 0.0, size),
            position=(x, y, z),
            text=line,
        )
        for number, ((line, colour), (x, y, z)) in enumerate(zip(lines, places, strict=True))
    ]


def clear_places(
    places: Sequence[NDArray[np.float64]],
    texts: Sequence[Sequence[str]],
    size: float,
    page: Page,
) -> list[NDArray[np.float64]]:
    """Where the middles of texts may stand so that none covers another; places (3,) are wished.

    The lowest stays where it is; one that is higher gives way upwards.
    """
    found = [place.copy() for place in places]
    ways = [(page.slope, 1.0), (OUTWARDS * (np.sign(page.up[2]) or 1.0), abs(page.up[2]))]
    done: list[int] = []
    for number in sorted(range(len(found)), key=lambda k: float(places[k] @ page.slope)):
        for other in done:
            both = [texts[number], texts[other]]
            width = LETTER_WIDTH * size * sum(max(map(len, lines)) for lines in both) / 2
            if abs((found[number] - found[other]) @ page.right) >= width:
                continue
            gap = LINE_STEP * size * (sum(map(len, both)) + 1) / 2
            for way, share in ways:
                missing = share * gap - (found[number] - found[other]) @ way
                found[number] += max(0.0, missing) * way
        done.append(number)
    return found
