"""Section V.B: spheres fitted to the markers under steel balls of 10 to 20 mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.scenes.description import Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiment import Case, Workplace
from paper.gel import Mechanics, mechanics_of
from paper.readings import READINGS, BothPrints

LEAST_POINTS = 4
# In units of the points' spread; so flat that no ball of the experiment comes near to it.
FLATTEST = 1e3


@dataclass(frozen=True)
class SphereFit:
    """centre (3,) and diameter, in the points' unit; rms: of the points' distances from it.

    count: points.  NaN throughout where the points bear no sphere.
    """

    centre: NDArray[np.float64]
    diameter: float
    rms: float
    count: int


def fit_sphere(points: NDArray[np.float64]) -> SphereFit:
    """The sphere with the least sum of squared distances to points (n, 3); NaN rows are left out.

    Geometric, not algebraic: noise on a small cap makes an algebraic fit's sphere too small.
    NaN for fewer than four points and for points that are all but flat.
    """
    points = points[np.isfinite(points).all(axis=-1)]
    none = SphereFit(np.full(3, np.nan), float("nan"), float("nan"), len(points))
    if len(points) < LEAST_POINTS:
        return none
    middle = points.mean(axis=0)
    scale = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
    if scale == 0:
        return none
    unit = (points - middle) / scale
    start = _algebraic(unit)
    if start is None:
        return none
    found = least_squares(_distances, start, _gradient, args=(unit,), method="lm", xtol=1e-12)
    radius = abs(float(found.x[3]))
    if not found.success or radius > FLATTEST:
        return none
    rms = float(np.sqrt(np.mean(found.fun**2)))
    return SphereFit(middle + scale * found.x[:3], 2 * scale * radius, scale * rms, len(points))


def _algebraic(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Centre and radius from the linear equations |p|^2 = 2 c . p + r^2 - |c|^2."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution, _, rank, _ = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)
    if rank < design.shape[1]:
        return None
    squared = solution[3] + solution[:3] @ solution[:3]
    return np.array([*solution[:3], np.sqrt(squared)])


def _distances(sphere: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(points - sphere[:3], axis=1) - sphere[3])


def _gradient(sphere: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    off = points - sphere[:3]
    return np.column_stack(
        [-off / np.linalg.norm(off, axis=1, keepdims=True), -np.ones(len(points))]
    )


DIAMETERS_MM = tuple(range(10, 21))
FAST_DIAMETERS_MM = (10, 15, 20)
# Where balls are pressed, in checkers from the middle of the pattern: nowhere special, so that
# no accident of the markers' places decides; a ball in the very middle of a checker stands on two
# rings of corners, and through these goes a sphere of any diameter that they share.
PLACES = ((0.13, 0.29), (-0.31, 0.07))
# Noises of each place; seeds of a ball lie below SEEDS_PER_BALL.
REPETITIONS = 2
SEEDS_PER_BALL = 100
# Markers less deep than this share of the deepest one are left out, as in the paper.
DEPTH_SHARE = 0.8
# Of the press, shown in order: every other one, so that markers move little from one to the next.
STEPS = 8
FRAMES = (2, 4, 6, 8)
SECONDS_PER_PLACE = 11.0


def ball_scene(diameter_mm: int, position: int, place: Workplace) -> Scene:
    """A ball pressed 0.6 mm deep at one of PLACES."""
    scene = load_scene(f"ball:{diameter_mm}mm")
    pitch = scene.sensor.pattern.pitch
    x, y = (share * pitch for share in PLACES[position])
    rest, press = scene.motion[:2]
    return replace(
        scene,
        name=f"ball_{diameter_mm}mm",
        start=Start(Touch((x, y), 0.0003)),
        motion=(replace(rest, frames=1), replace(press, frames=STEPS)),
        contact_nodes=32 if place.fast else scene.contact_nodes,
    )


def cases(place: Workplace) -> Sequence[Case]:
    """One for each ball."""
    diameters = FAST_DIAMETERS_MM if place.fast else DIAMETERS_MM
    positions = (0,) if place.fast else tuple(range(len(PLACES)))
    return [
        Case(
            f"{diameter}mm",
            fit_balls,
            (diameter, positions),
            seconds=4 + SECONDS_PER_PLACE * len(positions),
        )
        for diameter in diameters
    ]


def fit_balls(
    place: Workplace, diameter_mm: int, positions: tuple[int, ...]
) -> dict[str, NDArray[np.generic]]:
    """Fits of one ball at several places under several noises, by every reading.

    Of each reading `KEY_diameter`, `KEY_rms` m and `KEY_count` (places, repetitions).
    """
    rows: list[dict[str, list[SphereFit]]] = []
    prints: BothPrints | None = None
    for position in positions:
        scene = ball_scene(diameter_mm, position, place)
        prints = prints or BothPrints(scene.sensor)
        first = diameter_mm * SEEDS_PER_BALL + position * REPETITIONS
        seeds = range(first, first + REPETITIONS)
        rows.append(_at_place(prints, mechanics_of(scene, place), seeds))
    arrays: dict[str, NDArray[np.generic]] = {"ball": np.array(diameter_mm / 1000)}
    for key in rows[0]:
        for name in ("diameter", "rms", "count"):
            values = [[getattr(fit, name) for fit in row[key]] for row in rows]
            arrays[f"{key}_{name}"] = np.array(values)
    return arrays


def _at_place(
    prints: BothPrints, mechanics: Mechanics, seeds: Sequence[int]
) -> dict[str, list[SphereFit]]:
    """Fits by reading, one for each seed."""
    fits: dict[str, list[SphereFit]] = {reading.key: [] for reading in READINGS}
    pressed = prints.true_surface(mechanics, FRAMES[-1])
    for reading in READINGS:
        if reading.method is None:
            fit = _fit(reading.choose(prints.rest_surface), reading.choose(pressed))
            fits[reading.key] = [fit] * len(seeds)
    for course in prints.courses(mechanics, FRAMES, seeds):
        rest = _mean_rest(course.rest)
        for reading in READINGS:
            if reading.method is not None and reading.method.key == course.method:
                fit = _fit(reading.choose(rest), reading.choose(course.surfaces[FRAMES[-1]]))
                fits[reading.key].append(fit)
    return fits


def deep_points(rest: Surface, pressed: Surface) -> NDArray[np.float64]:
    """Markers (n, 3) m, virtual ones included, that are at least DEPTH_SHARE of the deepest down.

    How deep is the change of z against the same marker at rest.
    """
    at_rest, now = _all_points(rest), _all_points(pressed)
    depth = at_rest[:, 2] - now[:, 2]
    known = np.isfinite(depth)
    if not known.any():
        return np.empty((0, 3))
    deep = known & (depth >= DEPTH_SHARE * np.nanmax(depth))
    return np.asarray(now[deep])


def _fit(rest: Surface, pressed: Surface) -> SphereFit:
    return fit_sphere(deep_points(rest, pressed))


def _all_points(surface: Surface) -> NDArray[np.float64]:
    parts = surface.position, surface.row_position, surface.col_position
    return np.concatenate([part.reshape(-1, 3) for part in parts])


def _mean_rest(surfaces: Sequence[Surface]) -> Surface:
    """Mean positions of several measurements of the gel at rest; NaN where one has none."""
    first = surfaces[0]
    means = {
        name: np.mean([getattr(surface, name) for surface in surfaces], axis=0)
        for name in ("position", "row_position", "col_position")
    }
    return replace(first, **means)
