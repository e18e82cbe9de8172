"""Which pattern to print for a sensor, and its ink on a flat print, to scale."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.dot_code import DOT_DIAMETER
from cmp_tactile_processing.sensor.parts import (
    FEWEST_CODED,
    MAX_CORNERS,
    MIN_CORNERS,
    Pattern,
    PatternSurface,
)

MOST_HALVINGS = 20
# Where an image is compared with its chord, as shares of the side.
LOOKED_AT = (0.25, 0.5, 0.75)
Contour = NDArray[np.float64]
"""(N, 2) corners of a closed polygon, the last joined to the first.

Where y points up and x to the right, ink lies to the left of its way: counter-clockwise around
ink, clockwise around a hole in it.
"""
# along_axis: the print arrives along the gel's z axis (pad or transfer printing, exposure from
# above).  unrolled: a film is printed flat and laid around the gel.
PROCESSES = ("along_axis", "unrolled")
# Curved edges are polygons within this, m: a tenth of what the best printers resolve.
CHORD_TOLERANCE = 5e-7
# Measured by a sweep of prints, resolutions and lights, with tables in
# benchmarks/results/pattern_choice.md and the source, benchmarks/paper/pattern_choice.py, in commit
# 43949c8.  Sides are the smallest of both views.  Of checkers of RECOMMENDED_SIDE_PX the field
# between the markers is off by less than a third more than of the best ones, whatever the
# resolution and the light; below LEAST_SIDE_PX markers are lost in dim light or behind a soft lens.
LEAST_SIDE_PX = 6.0
RECOMMENDED_SIDE_PX = 7.0
# Dots of a code are read from this side on, and from the second on gridlines are as exact as
# without dots, to 8 %; both in focus: benchmarks/tracking/coded.py.
LEAST_CODED_SIDE_PX, EXACT_CODED_SIDE_PX = 7.5, 15.0
# A finer pitch than this share of the skin's thickness shows no more of a contact, however fine the
# camera's pixels.  Measured with a skin of 0.3 mm and beads of 1.2 mm; that it goes with the skin
# is assumed.
LEAST_PITCH_OVER_SKIN = 1.3
# More than these lower the error by less than 3 %, and cost time.
POINTS_PER_SEGMENT = 2
# A print of the same size as before is not larger in spite of rounding.
ROUNDING = 1e-6


def rectangle(half_x: float, half_y: float) -> Contour:
    """A rectangle of ink about the origin."""
    return np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])


def checker_contours(pattern: Pattern) -> list[Contour]:
    """Squares of the dark checkers, x and y of the gel frame, m.  They share corners only."""
    return [_on_gel(pattern, square) for square in _squares(pattern, dark=True)]


def light_checker_contours(pattern: Pattern) -> list[Contour]:
    """Ink of a light surrounding without the dark checkers: the hole in it, and what is left there.

    Light checkers at the border are one with their surrounding, so the hole is a comb.
    """
    inner = [
        square
        for square in _squares(pattern, dark=False)
        if square.min() >= 1 and (square.max(axis=0) <= (pattern.cols, pattern.rows)).all()
    ]
    return [_on_gel(pattern, contour) for contour in (_comb(pattern)[::-1], *inner)]


def dot_contours(centres: NDArray[np.float64], diameter: float) -> list[Contour]:
    """Dots of that diameter around centres (n, 2); m, as polygons within CHORD_TOLERANCE."""
    radius = diameter / 2
    count = max(12, math.ceil(math.pi / math.acos(1 - min(CHORD_TOLERANCE / radius, 0.5))))
    angles = np.arange(count) * (2 * math.pi / count)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return [centre + circle for centre in centres]


def code_contours(pattern: Pattern, *, dark_ink: bool) -> list[Contour]:
    """Dots of the code: ink in checkers without ink, holes in those of ink; m."""
    dots, inked = pattern.dots(), pattern.dark_checkers() == dark_ink
    middles, diameter = pattern.checker_middles(), DOT_DIAMETER * pattern.pitch
    ink, holes = (dot_contours(middles[dots & chosen], diameter) for chosen in (~inked, inked))
    return [*ink, *(hole[::-1] for hole in holes)]


def on_print(
    contours: list[Contour], flat: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> list[Contour]:
    """Contours laid flat, with so many corners that sides bend within CHORD_TOLERANCE."""
    return [flat(_divided(contour, flat)) for contour in contours]


def inset(contour: Contour, by: float) -> Contour:
    """The contour with every side moved into the ink by that much; negative: out of it."""
    if by == 0:
        return contour
    sides = np.roll(contour, -1, axis=0) - contour
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    after = np.stack([-sides[:, 1], sides[:, 0]], axis=-1)
    before = np.roll(after, 1, axis=0)
    towards = (before + after) / (1 + (before * after).sum(axis=1, keepdims=True))
    return np.asarray(contour + by * towards)


def _is_dark(pattern: Pattern, row: int, col: int) -> bool:
    """Of the checker outside corner (row, col): that of (0, 0) is the description's."""
    return (row + col) % 2 == (0 if pattern.corner_checker == "dark" else 1)


def _squares(pattern: Pattern, *, dark: bool) -> Iterator[Contour]:
    """In checkers: x from 0 to cols + 1, y from 0 to rows + 1."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for row in range(pattern.rows + 1):
        for col in range(pattern.cols + 1):
            if _is_dark(pattern, row, col) == dark:
                yield square + (col, row)


def _comb(pattern: Pattern) -> Contour:
    """Around all checkers but the light ones of the border, counter-clockwise, in checkers."""
    width, height = pattern.cols + 1, pattern.rows + 1
    sides: list[tuple[int, Callable[[float, float], tuple[float, float]]]] = [
        (width, lambda along, deep: (along, deep)),
        (height, lambda along, deep: (width - deep, along)),
        (width, lambda along, deep: (width - along, height - deep)),
        (height, lambda along, deep: (deep, height - along)),
    ]
    points = []
    for length, place in sides:
        for k in range(length - 1):
            col, row = (math.floor(value) for value in place(k + 0.5, 0.5))
            points += [place(*point) for point in _tooth(k, dark=_is_dark(pattern, row, col))]
    return np.array(points, dtype=np.float64)


def _tooth(k: int, *, dark: bool) -> list[tuple[float, float]]:
    """Way around the k-th checker of a side, (along, deep); the first lies at the corner."""
    if k == 0:
        return [(0, 0)] if dark else [(0, 1), (1, 1), (1, 0)]
    return [] if dark else [(k, 0), (k, 1), (k + 1, 1), (k + 1, 0)]


def _on_gel(pattern: Pattern, checkers: Contour) -> Contour:
    return pattern.at(checkers[:, 1] - 1, checkers[:, 0] - 1)[:, :2]


def _divided(
    contour: Contour, flat: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Contour:
    """With sides halved until each one's image lies within CHORD_TOLERANCE of its chord."""
    for _ in range(MOST_HALVINGS):
        ends = np.roll(contour, -1, axis=0)
        begin = flat(contour)
        chord = flat(ends) - begin
        across = np.zeros(len(contour))
        for share in LOOKED_AT:
            away = flat(contour * (1 - share) + ends * share) - begin
            bend = np.abs(chord[:, 0] * away[:, 1] - chord[:, 1] * away[:, 0])
            across = np.maximum(across, bend)
        bent = np.flatnonzero(across > CHORD_TOLERANCE * np.linalg.norm(chord, axis=1))
        if not len(bent):
            break
        contour = np.insert(contour, bent + 1, (contour[bent] + ends[bent]) / 2, axis=0)
    return contour


def default_process(surface: PatternSurface) -> str:
    """What gives the true pattern with the least equipment.

    A cylinder unrolls without any stretch, so a film that is laid around it is exact.  A film on
    a sphere wrinkles, so there the print is to arrive along the axis; on a plane both are one.
    """
    return "unrolled" if surface.type == "cylinder" else "along_axis"


def flat_print(
    surface: PatternSurface, process: str, xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Places (..., 2) m on the flat print of points (..., 2) m, x and y of the gel frame.

    The apex lies at (0, 0), axes along the gel's.  along_axis: the same x and y.  unrolled: arc
    length R asin(x / R) across a cylinder; on a sphere the distance from the apex, measured on the
    surface, in the direction of the point (azimuthal equidistant).  NaN beyond the surface.
    """
    xy = np.array(xy, dtype=np.float64)
    if process == "along_axis" or surface.type == "plane":
        return xy
    radius = surface.radius
    if surface.type == "cylinder":
        across = 1 if surface.axis == "x" else 0
        with np.errstate(invalid="ignore"):
            xy[..., across] = radius * np.arcsin(xy[..., across] / radius)
        return xy
    distance = np.hypot(xy[..., 0], xy[..., 1])
    with np.errstate(invalid="ignore"):
        arc = radius * np.arcsin(distance / radius)
    growth = np.divide(arc, distance, out=np.ones_like(arc), where=distance > 0)
    return xy * growth[..., None]


def rim_strain(surface: PatternSurface, process: str, xy: NDArray[np.float64]) -> float:
    """Greatest strain along the rim of a film that is laid on the gel, over points (..., 2) m.

    A circle of arc t R about a sphere's apex is 2 pi R sin(t) long, on the flat film 2 pi R t: the
    film is pushed together along it by 1 - sin(t) / t.  Negative, then; 0 on what unrolls.
    """
    if process == "along_axis" or surface.type != "sphere_cap":
        return 0.0
    farthest = float(np.hypot(xy[..., 0], xy[..., 1]).max()) / surface.radius
    return farthest / float(np.arcsin(farthest)) - 1 if farthest > 0 else 0.0


@dataclass(frozen=True)
class PrintOptions:
    """How the pattern is printed; lengths in m.

    process: one of PROCESSES, empty for the surface's default.  invert: ink is light, on dark skin.
    ink_gain: by how much ink spreads at each edge, taken off beforehand.  margin: light skin around
    the checkers, on which nothing else is printed.  bleed: how far inverted ink goes beyond it, and
    everything else stays away.
    """

    process: str = ""
    invert: bool = False
    ink_gain: float = 0.0
    margin: float = 0.001
    bleed: float = 0.0


@dataclass(frozen=True)
class PrintedPattern:
    """Polygons on the flat print, mm, apex at (0, 0), axes along the gel frame's x and y.

    ink: as Contour says, no two overlap.  clear: what is kept free for pattern, margin and bleed.
    gel: outline of the gel's block, None where it reaches beyond the surface.
    rim_strain: of a film that is laid on a sphere.  fits_gel: pattern and margin lie on the block,
    or the pattern goes on beyond the view and is to cover it.
    """

    pattern: Pattern
    options: PrintOptions
    process: str
    ink: tuple[Contour, ...]
    clear: Contour
    gel: Contour | None
    rim_strain: float
    fits_gel: bool


def printed_pattern(
    sensor: SensorDescription, options: PrintOptions | None = None
) -> PrintedPattern:
    """The ink of a sensor's pattern; of one that goes on beyond the view, on the whole skin.

    Raises InputError for a pattern that does not lie on its surface, and for an option that does
    not go with it.
    """
    options = options or PrintOptions()
    sensor = replace(sensor, pattern=sensor.sheet)
    pattern = sensor.pattern
    process = options.process or default_process(pattern.surface)
    _check(sensor, options, process)
    flat = partial(flat_print, pattern.surface, process)
    half = (pattern.cols + 1) * pattern.pitch / 2, (pattern.rows + 1) * pattern.pitch / 2
    around = options.margin + options.bleed
    clear = rectangle(half[0] + around, half[1] + around)
    with_margin = np.array(half) + options.margin
    gel = rectangle(sensor.elastomer.size[0] / 2, sensor.elastomer.size[1] / 2)
    laid = on_print(_ink(pattern, options, clear), flat)
    fits = with_margin <= np.array(sensor.elastomer.size[:2]) / 2 * (1 + 1e-9)
    return PrintedPattern(
        pattern=pattern,
        options=options,
        process=process,
        ink=tuple(inset(contour, options.ink_gain) * 1e3 for contour in laid),
        clear=on_print([clear], flat)[0] * 1e3,
        gel=_outline(gel, pattern, process),
        rim_strain=rim_strain(pattern.surface, process, rectangle(*with_margin)),
        fits_gel=bool(fits.all()) or pattern.border == "beyond_view",
    )


def _ink(pattern: Pattern, options: PrintOptions, clear: Contour) -> list[Contour]:
    """Contours on the gel, x and y, m."""
    code = code_contours(pattern, dark_ink=not options.invert)
    if options.invert:
        return [clear, *light_checker_contours(pattern), *code]
    return [*checker_contours(pattern), *code]


def _outline(gel: Contour, pattern: Pattern, process: str) -> Contour | None:
    flat = partial(flat_print, pattern.surface, process)
    if not np.isfinite(flat(gel)).all():
        return None
    return on_print([gel], flat)[0] * 1e3


def _check(sensor: SensorDescription, options: PrintOptions, process: str) -> None:
    pattern = sensor.pattern
    if process not in PROCESSES:
        raise InputError(f"process: found {process!r}, expected one of {', '.join(PROCESSES)}")
    for name in ("margin", "bleed"):
        if not getattr(options, name) >= 0:
            found = f"found {getattr(options, name) * 1e3:g} mm"
            raise InputError(f"{name}: {found}, expected 0 mm or more")
    _check_gain(pattern, options)
    _check_surface(sensor, options.margin + options.bleed)


def _check_gain(pattern: Pattern, options: PrintOptions) -> None:
    """What is printed must not vanish: half a checker, or a dot's radius."""
    share = 1.0 if pattern.code == "none" else DOT_DIAMETER
    most = share * pattern.pitch / 2
    if not 0 <= options.ink_gain < most:
        expected = f"expected 0 to less than {most * 1e6:.4g} um, at which nothing would be left"
        raise InputError(f"ink gain: found {options.ink_gain * 1e6:g} um, {expected}")
    # Light ink outside the checkers is a frame of margin and bleed, narrowed from both sides.
    frame = options.margin + options.bleed
    if options.invert and 0 < options.ink_gain >= frame / 2:
        found = f"found {options.ink_gain * 1e6:g} um on inverted ink"
        expected = f"expected 0, or less than half of margin and bleed, {frame * 1e6 / 2:.4g} um"
        raise InputError(f"ink gain: {found}, {expected}")


def _check_surface(sensor: SensorDescription, around: float) -> None:
    pattern, surface = sensor.pattern, sensor.pattern.surface
    size = np.array([pattern.cols + 1, pattern.rows + 1]) * pattern.pitch + 2 * around
    reach: NDArray[np.float64] = size / 2
    if surface.type == "plane":
        return
    if surface.type == "sphere_cap":
        needed = float(np.hypot(*reach))
    else:
        needed = float(reach[1 if surface.axis == "x" else 0])
    if not needed < surface.radius:
        raise InputError(
            f"{sensor.origin}: pattern.surface.radius: found {surface.radius * 1e3:.6g} mm, "
            f"expected more than {needed * 1e3:.6g} mm: the print, with margin and bleed, is "
            f"{size[0] * 1e3:.6g} x {size[1] * 1e3:.6g} mm"
        )


@dataclass(frozen=True)
class PatternAdvice:
    """rows, cols: inner corners; pitch m; least_side_px: shortest checker side of both views.

    reason: a sentence that says why.
    """

    rows: int
    cols: int
    pitch: float
    points_per_segment: int
    least_side_px: float
    reason: str


def checker_sides_px(sensor: SensorDescription) -> dict[str, NDArray[np.float64]]:
    """Sides (N,) px of all checkers between inner corners at rest, by view.

    NaN where a view's lens has no pixel for a corner.  Raises InputError where a view does
    not show the pattern, and where there is none.
    """
    return _sides(sensor.pattern, _views_of(sensor))


def _views_of(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    if not sensor.views:
        msg = f"{sensor.origin}: views: found none, expected at least one that shows the pattern"
        raise InputError(msg)
    return build_views(sensor)


def code_advice(sensor: SensorDescription) -> str:
    """What the dots of a code are like in this sensor's views, a sentence.

    Raises InputError where a view does not show the pattern.
    """
    side = _least(sensor.pattern, _views_of(sensor))
    checkers = f"in checkers of {side:.1f} px (the smallest) dots"
    if side < LEAST_CODED_SIDE_PX:
        return f"{checkers} cannot be read: at least {LEAST_CODED_SIDE_PX:g} px are needed"
    if side < EXACT_CODED_SIDE_PX:
        return (
            f"{checkers} can be read in focus, but make gridlines less exact; from "
            f"{EXACT_CODED_SIDE_PX:g} px on they do not"
        )
    return f"{checkers} can be read, and gridlines are as exact as without dots"


def why_no_dots(sensor: SensorDescription, ink_gain: float = 0.0) -> str:
    """Why a print should have no dots; empty where they fit, and cost no accuracy.

    ink_gain: m.
    """
    pattern = sensor.pattern
    checkers = (pattern.rows + 1) * (pattern.cols + 1)
    if checkers < FEWEST_CODED:
        return f"{checkers} checkers are too few, {FEWEST_CODED} are needed"
    if max(pattern.rows, pattern.cols) > MAX_CORNERS:
        return f"the largest sheet with dots has {MAX_CORNERS} rows and cols"
    if ink_gain >= DOT_DIAMETER * pattern.pitch / 2:
        return "the ink would fill the dots"
    try:
        side = _least(pattern, _views_of(sensor))
    except InputError:
        side = float("nan")
    if np.isnan(side):
        return "how large the checkers are in the image is not known"
    if side < EXACT_CODED_SIDE_PX:
        needed = f"{EXACT_CODED_SIDE_PX:g} px are needed"
        return f"the smallest checker has {side:.1f} px in the image, {needed}"
    return ""


def advise(sensor: SensorDescription) -> PatternAdvice:
    """The pattern to print on this sensor's gel, as large as the present one with its margin.

    The sensor's camera, optics, skin and size of the print count, not its present rows, columns
    and pitch.  Raises InputError where a view does not show the present pattern.
    """
    views = _views_of(sensor)
    least_pitch = LEAST_PITCH_OVER_SKIN * sensor.elastomer.shading_layer.thickness
    chosen, side = sensor.pattern, _least(sensor.pattern, views)
    by_skin = False
    for checkers in range(MAX_CORNERS + 1, MIN_CORNERS, -1):
        pattern = _on_print(sensor.pattern, checkers)
        if min(pattern.rows, pattern.cols) < MIN_CORNERS:
            break
        chosen, side = pattern, _least(pattern, views)
        if side >= RECOMMENDED_SIDE_PX:
            if pattern.pitch >= least_pitch:
                break
            by_skin = True
    return PatternAdvice(
        rows=chosen.rows,
        cols=chosen.cols,
        pitch=chosen.pitch,
        points_per_segment=POINTS_PER_SEGMENT,
        least_side_px=side,
        reason=_reason(chosen, side, by_skin=by_skin),
    )


def _reason(pattern: Pattern, side: float, *, by_skin: bool) -> str:
    """by_skin: the camera would see more checkers well."""
    if side < LEAST_SIDE_PX:
        return (
            f"even with {pattern.rows} x {pattern.cols} corners the smallest checker is only "
            f"{side:.1f} px wide, and below {LEAST_SIDE_PX:g} px markers are lost: the camera has "
            "too few pixels, or is too far from the gel"
        )
    if side < RECOMMENDED_SIDE_PX:
        return (
            f"the smallest allowed number of corners gives checkers of {side:.1f} px (the "
            f"smallest); {RECOMMENDED_SIDE_PX:g} px would be better"
        )
    if by_skin:
        return (
            f"the camera could see smaller checkers than these of {side:.1f} px, but the skin "
            f"over the pattern blurs details below {pattern.pitch * 1e3:.2f} mm"
        )
    if max(pattern.rows, pattern.cols) == MAX_CORNERS:
        return (
            f"the largest allowed number of corners still gives checkers of {side:.1f} px (the "
            f"smallest); {RECOMMENDED_SIDE_PX:g} px are enough"
        )
    return (
        f"the smallest checker of both views is then {side:.1f} px wide: below "
        f"{RECOMMENDED_SIDE_PX:g} px, markers are less exact; with larger checkers there are "
        "fewer markers"
    )


def _on_print(pattern: Pattern, checkers: int) -> Pattern:
    """So many checkers along the longer side of a print that is not larger than before."""
    width, height = ((count + 1) * pattern.pitch for count in (pattern.cols, pattern.rows))
    pitch = max(width, height) / checkers
    cols, rows = (int(length / pitch + ROUNDING) - 1 for length in (width, height))
    return replace(pattern, rows=rows, cols=cols, pitch=pitch)


def _least(pattern: Pattern, views: dict[str, ViewGeometry]) -> float:
    return min(float(np.min(sides)) for sides in _sides(pattern, views).values())


def _sides(pattern: Pattern, views: dict[str, ViewGeometry]) -> dict[str, NDArray[np.float64]]:
    found = {}
    for name, view in views.items():
        corners = view.project(pattern.corners())
        steps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).ravel() for axis in (0, 1)]
        found[name] = np.concatenate(steps)
    return found
