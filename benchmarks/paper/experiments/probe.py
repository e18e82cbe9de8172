"""Section V.C: how much of a small probe's depth the markers capture, at 25 points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Surface
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Phase, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiment import Case, Workplace
from paper.gel import Mechanics, mechanics_of
from paper.readings import (
    READINGS,
    BothPrints,
    Course,
    DepthField,
    Reading,
    nodes_of,
    true_displacement,
)

# A polynomial is sought for its deepest place on so many lines either way.
SEARCH_LINES = 41

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Dents:
    """Known markers: material coordinates xy (n, 2) m, depth (n,) m against the gel at rest."""

    xy: Array
    depth: Array


@dataclass(frozen=True)
class Neighbourhood:
    """Which markers a polynomial is fitted to.

    half: of the side of a square around the deepest marker, m.  nearest: or so many markers,
    where it is not 0.
    """

    half: float
    nearest: int = 0

    def contains(self, dents: Dents, centre: Array) -> NDArray[np.bool_]:
        """Which markers lie in it."""
        away = dents.xy - centre
        if self.nearest:
            distance = np.linalg.norm(away, axis=1)
            limit = np.sort(distance)[min(self.nearest, len(distance)) - 1]
            return np.asarray(distance <= limit + 1e-9)
        return np.asarray((np.abs(away) <= self.half + 1e-9).all(axis=1))


@dataclass(frozen=True)
class CapturedDepth:
    """depth: of the deepest marker, m.  fitted: deepest place of the polynomial, m."""

    depth: float
    fitted: float


def dents_of(surface: Surface, at_rest: Sequence[Surface], material: Surface) -> Dents:
    """Depths of all known markers of a surface.

    at_rest: as measured of the gel at rest; their mean is what depth is measured from.
    material: the exact markers at rest, whose x and y are the material coordinates.
    """
    depths, places = [], []
    for name in ("position", "row_position", "col_position"):
        rest = np.mean([getattr(item, name)[..., 2] for item in at_rest], axis=0)
        depths.append((rest - getattr(surface, name)[..., 2]).ravel())
        places.append(getattr(material, name)[..., :2].reshape(-1, 2))
    depth, xy = np.concatenate(depths), np.concatenate(places)
    known = np.isfinite(depth)
    return Dents(xy[known], depth[known])


def captured_depth(
    dents: Dents, around: tuple[float, float], reach: float, neighbourhood: Neighbourhood
) -> CapturedDepth:
    """What the markers within `reach`, m, of a place (x, y) m show of the dent there."""
    near = np.linalg.norm(dents.xy - around, axis=1) <= reach
    if not near.any():
        return CapturedDepth(float("nan"), float("nan"))
    deepest = int(np.argmax(np.where(near, dents.depth, -np.inf)))
    fitted = fitted_depth(dents, dents.xy[deepest], neighbourhood)
    return CapturedDepth(float(dents.depth[deepest]), fitted)


def fitted_depth(dents: Dents, centre: Array, neighbourhood: Neighbourhood) -> float:
    """Deepest place, m, of the quadratic in x and y through the markers around a centre (2,) m.

    Least squares; where the markers do not determine all six terms, the flattest of what fits.
    It is sought half as far from the centre, along x and along y, as the markers reach.
    """
    inside = neighbourhood.contains(dents, centre)
    away = dents.xy[inside] - centre
    reach = np.abs(away).max(axis=0)
    scale = reach.max()
    if scale <= 0:
        return float("nan")
    terms = np.linalg.lstsq(_quadratic(away / scale), dents.depth[inside], rcond=1e-6)[0]
    line = np.linspace(-0.5, 0.5, SEARCH_LINES)
    places = np.stack(np.meshgrid(*(line * side / scale for side in reach)), axis=-1)
    return float((_quadratic(places.reshape(-1, 2)) @ terms).max())


def _quadratic(xy: Array) -> Array:
    x, y = xy.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


PRESSED = 0.5e-3
HIGH_RESPONSE = 0.6
POINTS_PER_CASE = 5
# The deepest marker is sought so far from the probe, m: nothing else presses.
REACH = 1.2e-3
SPACING = 0.05e-3
# The points lie on nodes of these as well.
FAST_NODES = 41

# Three rows of three corners, or so many markers on the gridlines.
NEAREST = 9


@dataclass(frozen=True)
class _Site:
    """A point (x, y) m that is pressed.  material: exact markers at rest."""

    point: tuple[float, float]
    pattern: Pattern
    material: Surface
    field: DepthField


def cases(place: Workplace) -> Sequence[Case]:
    """The points row by row; in the fast run the nine of one quarter, which the others mirror."""
    seeds = tuple(range(1 if place.fast else 3))
    points = probe_points()
    if place.fast:
        chosen = tuple((x, y) for x, y in points if x <= 0 and y <= 0)
        return (Case("probe-points", captured_at, (chosen, seeds), seconds=40.0),)
    return tuple(
        Case(
            f"probe-points-{n}",
            captured_at,
            (points[first : first + POINTS_PER_CASE], seeds),
            seconds=40.0,
        )
        for n, first in enumerate(range(0, len(points), POINTS_PER_CASE))
    )


def probe_points() -> tuple[tuple[float, float], ...]:
    """Where the scene presses, (x, y) m, in order."""
    goals = [phase.goal for phase in load_scene("probe").motion]
    return tuple(goal.at for goal in goals if isinstance(goal, Touch))


def captured_at(
    place: Workplace, points: Sequence[tuple[float, float]], seeds: Sequence[int]
) -> dict[str, Array]:
    """What every reading captures of the probe at these points.

    `points` (P, 2) m; `true` (P,) m, deepest place of the marker surface; `corner` (P,) m, way
    from the point to the nearest corner at rest; `corner_xy` (P, n, 2) m; by reading KEY, each
    (P, seeds) m: `KEY_depth` of the deepest marker, `KEY_square` and `KEY_nearest` of the
    quadratic through its neighbours, `KEY_dense` of the dense surface.
    """
    data: dict[str, list[Any]] = {}
    prints: BothPrints | None = None
    for point in points:
        scene = point_scene(point)
        if place.fast:
            scene = replace(scene, contact_nodes=FAST_NODES)
        mechanics = mechanics_of(scene, place)
        prints = prints or BothPrints(scene.sensor)
        for name, value in _row_at(point, mechanics, prints, seeds).items():
            data.setdefault(name, []).append(value)
    return {name: np.array(value) for name, value in data.items()}


def _row_at(
    point: tuple[float, float], mechanics: Mechanics, prints: BothPrints, seeds: Sequence[int]
) -> dict[str, Any]:
    """The row of `captured_at` for a point."""
    pattern, rest = prints.sensor.pattern, prints.rest_surface
    frames = [n for n, phase in enumerate(mechanics.phase) if phase.startswith("press")]
    last = frames[-1]
    courses = list(prints.courses(mechanics, frames, seeds))
    exact = Course("", 0, [rest], {last: prints.true_surface(mechanics, last)})
    site = _Site(point, pattern, rest, DepthField(pattern, SPACING))
    corners = pattern.corners()[..., :2].reshape(-1, 2)
    data: dict[str, Any] = {
        "points": point,
        "true": _true_depth(mechanics.surface(last, pattern), point),
        "corner": np.linalg.norm(corners - point, axis=-1).min(),
        "corner_xy": corners,
    }
    for reading in READINGS:
        depths = [
            _depths(reading, course, last, site) for course in reading.courses(courses, exact)
        ]
        data |= {f"{reading.key}_{name}": [d[name] for d in depths] for name in depths[0]}
    return data


def point_scene(point: tuple[float, float]) -> Scene:
    """The scene's probe, pressed in at one point."""
    scene = load_scene("probe")
    clearance = scene.start.place.clearance if isinstance(scene.start.place, Touch) else 0.0
    first = next(n for n, phase in enumerate(scene.motion) if isinstance(phase.goal, Touch))
    phases: tuple[Phase, ...] = scene.motion[first : first + 3]
    x, y = (round(1e6 * value) for value in point)
    motion = tuple(
        replace(p, goal=Touch(point, clearance)) if n == 0 else p for n, p in enumerate(phases)
    )
    return replace(
        scene, name=f"probe-{x}-{y}um", start=Start(Touch(point, clearance)), motion=motion
    )


def _true_depth(surface: DeformedSurface, point: tuple[float, float]) -> float:
    """Deepest place of the marker surface around a point, m."""
    line = np.arange(-REACH, REACH, SPACING / 2)
    xy = np.stack(np.meshgrid(line, line), axis=-1) + point
    depth = -true_displacement(surface, xy)[..., 2]
    return float(depth.max())


def _depths(reading: Reading, course: Course, frame: int, site: _Site) -> Mapping[str, float]:
    """Depths of the dent at a site, m, by the way they are found."""
    surface, rest = (
        reading.choose(course.surfaces[frame]),
        [reading.choose(item) for item in course.rest],
    )
    dents, square = dents_of(surface, rest, site.material), Neighbourhood(site.pattern.pitch)
    by_square = captured_depth(dents, site.point, REACH, square)
    by_nearest = captured_depth(dents, site.point, REACH, replace(square, nearest=NEAREST))
    near = np.linalg.norm(nodes_of(site.field.grid) - site.point, axis=-1) <= REACH
    return {
        "depth": by_square.depth,
        "square": by_square.fitted,
        "nearest": by_nearest.fitted,
        "dense": float(np.nanmax(site.field.depth(surface)[near])),
    }
