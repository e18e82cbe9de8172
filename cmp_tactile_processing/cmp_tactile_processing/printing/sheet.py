"""A sheet of paper or film with copies of a printed pattern: what is drawn on it, in mm."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import PrintedPattern
from cmp_tactile_processing.sensor.parts import PatternSurface

# Names of the layers; the ink's polygons lie on PATTERN, labels on TEXT.
LAYERS = ("PATTERN", "REGISTRATION", "OUTLINE", "CUT", "TEXT")
LINE_WIDTH = 0.1
# Registration targets: half the length of their crosses, radius, and the room that is left
# between them and the gel's outline; they lie on multiples of MARK_STEP.
CROSS, TARGET, MARK_ROOM, MARK_STEP = 2.0, 1.0, 3.0, 0.5
ARROW, ARROW_HEAD = 5.0, 0.8
BAR, BAR_ROOM = 10.0, 6.0
FONT, LINE_SPACING = 1.6, 2.2
# Width of a character of a sans-serif font, of its size: more than texts have on average.
CHARACTER = 0.56
LONGEST_NAME = 40
CIRCLE_CORNERS = 72
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
            lines=tuple(replace(line, points=line.points + step) for line in self.lines),
            labels=tuple(
                replace(label, place=(label.place[0] + by[0], label.place[1] + by[1]))
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


@dataclass(frozen=True)
class PrintedCopy:
    """Drawing with the apex at (0, 0); low, high: (2,) corners of the room that it takes.

    targets: half the distances of the registration targets along x and y of the gel frame.
    mirrored: seen from the camera's side (x right, y down), not from the object's (y up).
    """

    drawing: Drawing
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    targets: tuple[float, float]
    mirrored: bool


def printed_copy(name: str, printed: PrintedPattern, *, mirrored: bool = False) -> PrintedCopy:
    """One copy, in mm on the page.

    From the object's side, against the gel frame's z axis, x points to the right and y up: corner
    (0, 0) is at the bottom left.  The camera looks along z and has y down: corner (0, 0) is at the
    top left.  The marks are mirrored with the pattern, text is not.
    """
    targets = _targets(printed)
    up = np.array([1.0, 1.0 if mirrored else -1.0])
    marks = _registration(targets, up)
    outline = () if printed.gel is None else (Line(printed.gel * up, "OUTLINE", closed=True),)
    pattern = Drawing(ink=(tuple(contour * up for contour in printed.ink),), lines=outline)
    labels = _text(_facts(name, printed, targets, mirrored=mirrored), targets)
    below = scale_bar(BAR, 1.0).moved((-BAR / 2, targets[1] + BAR_ROOM - 0.5))
    beside = scale_bar(BAR, 1.0, upright=True).moved((targets[0] + BAR_ROOM - 1.5, -BAR / 2))
    drawing = Drawing.together([pattern, marks, below, beside, Drawing(labels=labels)])
    low, high = _room(drawing)
    return PrintedCopy(drawing, low, high, targets, mirrored)


def scale_bar(length: float, step: float, *, upright: bool = False) -> Drawing:
    """A bar from (0, 0) to the right, or down, with ticks towards the other side and its length."""
    count = round(length / step)
    axes = np.array([[0.0, 1.0], [1.0, 0.0]]) if upright else np.array([[1.0, 0.0], [0.0, -1.0]])
    lines = [Line(np.array([[0.0, 0.0], [length, 0.0]]) @ axes, "REGISTRATION")]
    for k in range(count + 1):
        tick = 1.0 if k % count == 0 else 0.7 if 2 * k == count else 0.45
        ends = np.array([[k * step, 0.0], [k * step, tick]])
        lines.append(Line(ends @ axes, "REGISTRATION"))
    place = (0.0, -0.6) if upright else (length + 0.8, 0.0)
    text = Label(f"{length:g} mm", place, FONT, "middle" if upright else "start")
    return Drawing(lines=tuple(lines), labels=(text,))


def _targets(printed: PrintedPattern) -> tuple[float, float]:
    """Half distances of the targets: outside everything, at round coordinates."""
    kept_free = [printed.clear] if printed.gel is None else [printed.clear, printed.gel]
    reach = np.abs(np.concatenate(kept_free)).max(axis=0) + MARK_ROOM
    x, y = (math.ceil(value / MARK_STEP - 1e-9) * MARK_STEP for value in reach)
    return x, y


def _registration(targets: tuple[float, float], up: NDArray[np.float64]) -> Drawing:
    """Four targets; that of corner (0, 0) is filled in one quarter, and axes begin at it."""
    corner = -np.array(targets)
    lines = [
        line
        for sign in ((-1, -1), (1, -1), (-1, 1), (1, 1))
        for line in _target(np.array(sign) * targets)
    ]
    labels = [_corner_label(corner, up)]
    for axis, name in enumerate(("x", "y")):
        along = np.eye(2)[axis]
        begin = corner + along * (CROSS + 0.5)
        tip = begin + along * ARROW
        aside = np.eye(2)[1 - axis] * ARROW_HEAD / 2
        head = [tip - along * ARROW_HEAD + aside, tip, tip - along * ARROW_HEAD - aside]
        lines += [
            Line(np.array([begin, tip]), "REGISTRATION"),
            Line(np.array(head), "REGISTRATION"),
        ]
        place = (tip + along * 1.2) * up + (0, 0.5)
        labels.append(Label(name, (float(place[0]), float(place[1])), FONT, "middle"))
    return Drawing(
        solids=((_quarter() + corner) * up,),
        lines=tuple(Line(line.points * up, line.layer, line.closed) for line in lines),
        labels=tuple(labels),
    )


def _target(centre: NDArray[np.float64]) -> Iterator[Line]:
    for direction in np.eye(2):
        ends = np.array([centre - CROSS * direction, centre + CROSS * direction])
        yield Line(ends, "REGISTRATION")
    yield Line(centre + TARGET * _directions(0, CIRCLE_CORNERS), "REGISTRATION", closed=True)


def _quarter() -> NDArray[np.float64]:
    """The quarter of a target that looks away from the pattern at corner (0, 0)."""
    arc = TARGET * _directions(CIRCLE_CORNERS // 2, CIRCLE_CORNERS // 4 + 1)
    return np.concatenate([np.zeros((1, 2)), arc])


def _directions(first: int, count: int) -> NDArray[np.float64]:
    angles = (first + np.arange(count)) * (2 * math.pi / CIRCLE_CORNERS)
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _corner_label(corner: NDArray[np.float64], up: NDArray[np.float64]) -> Label:
    x, y = corner * up
    beyond = CROSS + 0.4
    return Label("(0, 0)", (x - CROSS, y + (beyond + 0.7 * FONT if y > 0 else -beyond)), FONT)


def _facts(
    name: str, printed: PrintedPattern, targets: tuple[float, float], *, mirrored: bool
) -> Iterator[str]:
    pattern, options = printed.pattern, printed.options
    name = " ".join(name.split())
    yield name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 3]}..."
    kind = "corners" if options.pattern_type == "cmp" else "dots"
    yield f"{pattern.rows} x {pattern.cols} {kind}, pitch {pattern.pitch * 1e3:.5g} mm"
    if pattern.code != "none" and options.pattern_type == "cmp":
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
    yield f"targets at x = ±{targets[0]:g}, y = ±{targets[1]:g} mm"
    yield "print at 100 %"


def _shape(surface: PatternSurface) -> str:
    if surface.type == "plane":
        return "plane"
    name = f"cylinder along {surface.axis}" if surface.type == "cylinder" else "sphere cap"
    return f"{name}, R {surface.radius * 1e3:g} mm"


def _text(facts: Iterator[str], targets: tuple[float, float]) -> tuple[Label, ...]:
    left, first = -targets[0] - CROSS, targets[1] + BAR_ROOM + LINE_SPACING
    return tuple(
        Label(fact, (left, first + k * LINE_SPACING), FONT) for k, fact in enumerate(facts)
    )


def _room(drawing: Drawing) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    points = [contour for copy in drawing.ink for contour in copy]
    points += [line.points for line in drawing.lines]
    for label in drawing.labels:
        width = len(label.text) * CHARACTER * label.size
        begin = label.place[0] - {"start": 0.0, "middle": 0.5, "end": 1.0}[label.anchor] * width
        y = label.place[1]
        points.append(np.array([[begin, y - label.size], [begin + width, y + 0.3 * label.size]]))
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)


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

    Raises InputError where they have no room.
    """
    if paper not in PAPERS:
        raise InputError(f"paper: found {paper!r}, expected one of {', '.join(PAPERS)}")
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
        raise InputError(f"copies: found {copies}, expected 1 or more")
    if paper == "fit":
        columns = math.ceil(math.sqrt(copies * tile[1] / tile[0]))
        return (EDGE_OF_FIT, EDGE_OF_FIT), min(columns, copies)
    first = EDGE + ASIDE, EDGE + HEAD
    room = np.array(PAPERS[paper]) - EDGE - first
    columns, rows = (int(count) for count in np.floor(room / tile))
    size = f"{tile[0]:.1f} x {tile[1]:.1f} mm"
    if columns * rows == 0:
        raise InputError(
            f"paper: found {paper} with room for {room[0]:.1f} x {room[1]:.1f} mm, expected room "
            f"for {size}; use paper fit"
        )
    if copies > columns * rows:
        raise InputError(
            f"copies: found {copies}, expected at most {columns * rows} of {size} on {paper}; "
            "paper fit takes any number"
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
