"""A sheet of paper or film with copies of a printed pattern, cut lines and rulers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.printing.copies import PrintedCopy, scale_bar
from cmp_tactile_processing.printing.drawing import Drawing, Label, Line

__all__ = ["PAPERS", "PrintSheet", "print_sheet"]

# Width and height, mm; fit is as large as it must be.
PAPERS = {"A4": (210.0, 297.0), "letter": (215.9, 279.4), "fit": (math.inf, math.inf)}
# What office printers leave free at the edges.
EDGE = 10.0
EDGE_OF_FIT = 5.0
# Room for the line above, with a ruler, and for the ruler on the left.
HEAD, ASIDE = 14.0, 6.0
RULER = 100.0
GAP = 2.0
TITLE_FONT = 2.8
NOTE = "Print at 100 % (actual size, not fitted to the page), then measure both rulers."


@dataclass(frozen=True)
class PrintSheet:
    """Size, mm, and drawing of the sheet; origins: where the apex of each copy lies on it, mm
    from the top left corner."""

    width: float
    height: float
    drawing: Drawing
    origins: tuple[tuple[float, float], ...]


def print_sheet(copy: PrintedCopy, paper: str = "A4", copies: int = 1) -> PrintSheet:
    """So many copies in rows and columns on a paper of PAPERS.

    Raises ParameterError where they have no room.
    """
    if paper not in PAPERS:
        raise ParameterError(f"paper: found {paper!r}, expected one of {', '.join(PAPERS)}")
    tile = copy.high - copy.low + GAP
    first, columns = _grid(tile, paper, copies)
    rows = math.ceil(copies / columns)
    used = min(copies, columns), rows
    places = [
        (first[0] + (k % columns) * tile[0], first[1] + (k // columns) * tile[1])
        for k in range(copies)
    ]
    origins = tuple(
        (float(x + GAP / 2 - copy.low[0]), float(y + GAP / 2 - copy.low[1])) for x, y in places
    )
    parts = [copy.drawing.moved(origin) for origin in origins]
    if copies > 1:
        parts.append(Drawing(lines=tuple(_cuts(first, (tile[0], tile[1]), used))))
    if paper == "fit":
        size = first[0] + used[0] * tile[0] + EDGE_OF_FIT, first[1] + rows * tile[1] + EDGE_OF_FIT
        width, height = (float(math.ceil(length)) for length in size)
    else:
        width, height = PAPERS[paper]
        parts.append(_rulers())
    return PrintSheet(width, height, Drawing.together(parts), origins)


def _grid(tile: NDArray[np.float64], paper: str, copies: int) -> tuple[tuple[float, float], int]:
    """Top left corner of the first copy, and how many stand side by side."""
    if copies < 1:
        raise ParameterError(f"copies: found {copies}, expected 1 or more")
    if paper == "fit":
        columns = math.ceil(math.sqrt(copies * tile[1] / tile[0]))
        return (EDGE_OF_FIT, EDGE_OF_FIT), min(columns, copies)
    first = EDGE + ASIDE, EDGE + HEAD
    room = np.array(PAPERS[paper]) - EDGE - first
    columns, rows = (int(count) for count in np.floor(room / tile))
    size = f"{tile[0]:.1f} x {tile[1]:.1f} mm"
    if columns * rows == 0:
        raise ParameterError(
            f"paper: found {paper} with room for {room[0]:.1f} x {room[1]:.1f} mm, expected "
            f"room for {size}; paper fit is as large as it must be"
        )
    if copies > columns * rows:
        raise ParameterError(
            f"copies: found {copies}, expected at most {columns * rows} of {size} on {paper}; "
            f"paper fit takes any number"
        )
    return first, columns


def _cuts(
    first: tuple[float, float], tile: tuple[float, float], used: tuple[int, int]
) -> Iterator[Line]:
    """Lines between and around the copies."""
    width, height = used[0] * tile[0], used[1] * tile[1]
    for k in range(used[0] + 1):
        x = first[0] + k * tile[0]
        yield Line(np.array([[x, first[1]], [x, first[1] + height]]), "CUT")
    for k in range(used[1] + 1):
        y = first[1] + k * tile[1]
        yield Line(np.array([[first[0], y], [first[0] + width, y]]), "CUT")


def _rulers() -> Drawing:
    """The note at the top, and a ruler along each edge: printers scale both ways differently."""
    note = Label(NOTE, (EDGE, EDGE + TITLE_FONT), TITLE_FONT)
    across = scale_bar(RULER, 10.0).moved((EDGE + ASIDE, EDGE + HEAD - 5))
    down = scale_bar(RULER, 10.0, upright=True).moved((EDGE + ASIDE / 2, EDGE + HEAD))
    return Drawing.together([Drawing(labels=(note,)), across, down])
