"""A sheet of paper or film with a printed pattern: what is drawn on it, in mm."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import Contour, PrintedPattern
from cmp_tactile_processing.sensor.parts import PatternSurface

# Names of the layers; the ink's polygons lie on PATTERN, labels on TEXT.
LAYERS = ("PATTERN", "OUTLINE", "MARKS", "TEXT")
LINE_WIDTH = 0.1
# The axes begin this far outside of all that is kept free.
MARK_ROOM = 3.0
ARROW, ARROW_HEAD = 6.0, 0.8
BAR, BAR_ROOM = 10.0, 6.0
FONT, LINE_SPACING = 1.6, 2.2
# Width of a character of a sans-serif font, of its size: more than texts have on average.
CHARACTER = 0.56
LONGEST_NAME = 40
# Width and height, mm; fit is as large as it must be.
PAPERS = {"A4": (210.0, 297.0), "letter": (215.9, 279.4), "fit": (math.inf, math.inf)}
# What office printers leave free at the edges.
EDGE = 10.0
EDGE_OF_FIT = 5.0
# Room for the line above, with a ruler, and for the ruler on the left.
HEAD, ASIDE = 14.0, 6.0
RULER = 100.0
TITLE_FONT = 2.8
NOTE = "Print at 100 % (actual size, not fitted to the page), then measure both rulers."


@dataclass(frozen=True)
class Line:
    """A line through points (N, 2), closed or not, on OUTLINE or MARKS."""

    points: NDArray[np.float64]
    layer: str = "MARKS"
    closed: bool = False


@dataclass(frozen=True)
class Label:
    """Text in one line; place: of its base line; size: of the font, mm.

    anchor: start, middle or end, the part of the text that stands at the place.
    """

    text: str
    place: tuple[float, float]
    size: float = FONT
    anchor: str = "start"


@dataclass(frozen=True)
class PrintSheet:
    """Everything in mm, x to the right, y *down*, from the top left corner of the page.

    apex: of the pattern.  ink: polygons (N, 2), filled by the even-odd and by the non-zero rule
    alike.  mirrored: seen from the camera's side, not from the object's.
    """

    width: float
    height: float
    apex: NDArray[np.float64]
    ink: tuple[Contour, ...]
    lines: tuple[Line, ...]
    labels: tuple[Label, ...]
    mirrored: bool


def print_sheet(
    name: str, printed: PrintedPattern, paper: str = "A4", *, mirrored: bool = False
) -> PrintSheet:
    """The pattern on a paper of PAPERS; InputError where it has no room.

    From the object's side, against the gel frame's z axis, x points to the right and y up: corner
    (0, 0) is at the bottom left.  The camera looks along z and has y down: corner (0, 0) is at the
    top left.  The marks are mirrored with the pattern, text is not.
    """
    if paper not in PAPERS:
        raise InputError(f"paper: found {paper!r}, expected one of {', '.join(PAPERS)}")
    up = np.array([1.0, 1.0 if mirrored else -1.0])
    ink = [contour * up for contour in printed.ink]
    lines, labels = _around(name, printed, up, mirrored=mirrored)
    low, high = _room([*ink, printed.clear * up], lines, labels)
    first = np.array([EDGE + ASIDE, EDGE + HEAD])
    if paper == "fit":
        first = np.full(2, EDGE_OF_FIT)
        width, height = np.ceil(first + high - low + EDGE_OF_FIT).tolist()
    else:
        width, height = PAPERS[paper]
        room = np.array(PAPERS[paper]) - EDGE - first
        if (high - low > room).any():
            expected = f"{high[0] - low[0]:.1f} x {high[1] - low[1]:.1f} mm"
            raise InputError(
                f"paper: found {paper} with room for {room[0]:.1f} x {room[1]:.1f} mm, expected "
                f"room for {expected}; use paper fit"
            )
    apex = first - low
    lines = [replace(line, points=line.points + apex) for line in lines]
    labels = [replace(label, place=_place(label.place + apex)) for label in labels]
    if paper != "fit":
        labels.append(Label(NOTE, (EDGE, EDGE + TITLE_FONT), TITLE_FONT))
        _add_bar(lines, labels, (EDGE + ASIDE, EDGE + HEAD - 5), RULER)
        _add_bar(lines, labels, (EDGE + ASIDE / 2, EDGE + HEAD), RULER, upright=True)
    placed = tuple(contour + apex for contour in ink)
    return PrintSheet(width, height, apex, placed, tuple(lines), tuple(labels), mirrored)


def _around(
    name: str, printed: PrintedPattern, up: NDArray[np.float64], *, mirrored: bool
) -> tuple[list[Line], list[Label]]:
    """The gel's outline, axes at corner (0, 0), bars and text, with the apex at (0, 0)."""
    lines, labels = [], []
    kept_free = [printed.clear]
    if printed.gel is not None:
        kept_free.append(printed.gel)
        lines.append(Line(printed.gel * up, "OUTLINE", closed=True))
    reach = np.abs(np.concatenate(kept_free)).max(axis=0) + MARK_ROOM
    for axis, letter in enumerate(("x", "y")):
        along, aside = np.eye(2)[axis], np.eye(2)[1 - axis] * ARROW_HEAD / 2
        tip = along * ARROW - reach
        head = [tip - along * ARROW_HEAD + aside, tip, tip - along * ARROW_HEAD - aside]
        lines += [Line(np.array(points) * up) for points in ([-reach, tip], head)]
        place = (tip + along * 1.2) * up + (0, 0.5)
        labels.append(Label(letter, _place(place), anchor="middle"))
    y = reach[1] if up[1] < 0 else -reach[1]
    labels.append(Label("(0, 0)", (float(-reach[0]), float(y + (1.8 if y > 0 else -0.7)))))
    _add_bar(lines, labels, (-BAR / 2, reach[1] + BAR_ROOM - 0.5), BAR)
    _add_bar(lines, labels, (reach[0] + BAR_ROOM - 1.5, -BAR / 2), BAR, upright=True)
    first = reach[1] + BAR_ROOM + LINE_SPACING
    labels += [
        Label(fact, (float(-reach[0]), float(first + k * LINE_SPACING)))
        for k, fact in enumerate(_facts(name, printed, mirrored=mirrored))
    ]
    return lines, labels


def _add_bar(
    lines: list[Line],
    labels: list[Label],
    place: tuple[float, float],
    length: float,
    *,
    upright: bool = False,
) -> None:
    """A bar to the right, or down, with ten parts marked on the other side, and its length."""
    axes = np.array([[0.0, 1.0], [1.0, 0.0]]) if upright else np.array([[1.0, 0.0], [0.0, -1.0]])
    ways = [[[0.0, 0.0], [length, 0.0]]]
    for k in range(11):
        tick = {0: 1.0, 5: 0.7, 10: 1.0}.get(k, 0.45)
        ways.append([[k * length / 10, 0.0], [k * length / 10, tick]])
    lines += [Line(np.array(way) @ axes + place) for way in ways]
    beside = (0.0, -0.6) if upright else (length + 0.8, 0.0)
    anchor = "middle" if upright else "start"
    labels.append(Label(f"{length:g} mm", _place(np.add(place, beside)), anchor=anchor))


def _facts(name: str, printed: PrintedPattern, *, mirrored: bool) -> Iterator[str]:
    pattern, options = printed.pattern, printed.options
    name = " ".join(name.split())
    yield name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 3]}..."
    yield f"{pattern.rows} x {pattern.cols} corners, pitch {pattern.pitch * 1e3:.5g} mm"
    if pattern.code != "none":
        yield f"code: {pattern.code}, seed {pattern.code_seed}"
    yield f"{_shape(pattern.surface)}, {printed.process}"
    yield "MIRRORED: seen from the camera" if mirrored else "seen from the touching side"
    yield "print side onto the gel" if mirrored else "print side away from the gel"
    if printed.rim_strain:
        yield f"the film's rim is compressed by {-printed.rim_strain:.1%}"
    if options.invert:
        yield "inverted: the light parts are printed"
    if options.ink_gain:
        yield f"edges moved by {options.ink_gain * 1e6:g} um for ink gain"
    yield "print at 100 %"


def _shape(surface: PatternSurface) -> str:
    if surface.type == "plane":
        return "plane"
    name = f"cylinder along {surface.axis}" if surface.type == "cylinder" else "sphere cap"
    return f"{name}, R {surface.radius * 1e3:g} mm"


def _room(
    contours: list[Contour], lines: list[Line], labels: list[Label]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest coordinates of everything, texts included."""
    points = [*contours, *(line.points for line in lines)]
    for label in labels:
        width = len(label.text) * CHARACTER * label.size
        begin = label.place[0] - {"start": 0.0, "middle": 0.5, "end": 1.0}[label.anchor] * width
        y = label.place[1]
        points.append(np.array([[begin, y - label.size], [begin + width, y + 0.3 * label.size]]))
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)


def _place(place: NDArray[np.float64]) -> tuple[float, float]:
    return float(place[0]), float(place[1])
