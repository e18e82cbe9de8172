"""Section V.C: how much of a small probe's depth the markers capture, at 25 points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Phase, Scene, Start, Touch
from cmp_tactile_simulation.scenes.library import load_scene
from paper.captured_depth import Neighbourhood, captured_depth, dents_of
from paper.depth_field import DepthField, nodes_of, true_displacement
from paper.experiment import Case, Workplace
from paper.mechanics import Mechanics, mechanics_of
from paper.readings import READINGS, Reading, Reels, Take

__all__ = ["HIGH_RESPONSE", "POINTS_PER_CASE", "PRESSED", "cases", "probe_points"]

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

Array = NDArray[np.float64]


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
    told: dict[str, list[Any]] = {}
    reels: Reels | None = None
    for point in points:
        scene = point_scene(point)
        if place.fast:
            scene = replace(scene, contact_nodes=FAST_NODES)
        mechanics = mechanics_of(scene, place)
        reels = reels or Reels(scene.sensor)
        for name, value in _told_at(point, mechanics, reels, seeds).items():
            told.setdefault(name, []).append(value)
    return {name: np.array(value) for name, value in told.items()}


def _told_at(
    point: tuple[float, float], mechanics: Mechanics, reels: Reels, seeds: Sequence[int]
) -> dict[str, Any]:
    """The row of `captured_at` for a point."""
    pattern, rest = reels.sensor.pattern, reels.rest_surface
    frames = [n for n, phase in enumerate(mechanics.phase) if phase.startswith("press")]
    last = frames[-1]
    takes = list(reels.takes(mechanics, frames, seeds))
    exact = Take("", 0, [rest], {last: reels.true_surface(mechanics, last)})
    site = _Site(point, pattern, rest, DepthField(pattern, SPACING))
    corners = pattern.corners()[..., :2].reshape(-1, 2)
    told: dict[str, Any] = {
        "points": point,
        "true": _true_depth(mechanics.surface(last, pattern), point),
        "corner": np.linalg.norm(corners - point, axis=-1).min(),
        "corner_xy": corners,
    }
    for reading in READINGS:
        depths = [_depths(reading, take, last, site) for take in reading.takes(takes, exact)]
        told |= {f"{reading.key}_{name}": [d[name] for d in depths] for name in depths[0]}
    return told


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


def _depths(reading: Reading, take: Take, frame: int, site: _Site) -> Mapping[str, float]:
    """Depths of the dent at a site, m, by the way they are found."""
    surface, rest = reading.of(take.surfaces[frame]), [reading.of(item) for item in take.rest]
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
