"""Section IV.E: five small spheres, and how near two of them may be to be distinguished."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.experiment import Case, Workplace
from paper.gel import Mechanics, mechanics_of
from paper.readings import (
    READINGS,
    BothPrints,
    Course,
    DepthField,
    nodes_of,
    sampled,
    true_displacement,
)

# Between two points of light that are just resolved the light falls to 73.5 % (Rayleigh).
RAYLEIGH_DIP = 0.265
# Two maxima at all, by more than noise and interpolation make of one.
LEAST_DIP = 0.05
# The line goes on so far beyond both contacts, and its points are so far apart, m.
BEYOND, STEP = 0.4e-3, 25e-6

Array = NDArray[np.float64]


def line_through(centre: Array, angle: float, separation: float) -> Array:
    """Points (n, 2) m on the line through two contacts; the middle one is half way."""
    count = round((separation / 2 + BEYOND) / STEP)
    along = np.arange(-count, count + 1) * STEP
    return np.asarray(centre + along[:, None] * (np.cos(angle), np.sin(angle)))


def dip_between(depth: Array) -> float:
    """By what share of the smaller of two maxima the depth falls between them.

    depth (n,): along `line_through`, a maximum on each side of its middle.  0 where it does not
    fall; NaN where a depth is missing or nothing is pressed in.
    """
    middle = len(depth) // 2
    first = int(np.argmax(depth[: middle + 1]))
    second = middle + int(np.argmax(depth[middle:]))
    smaller = float(min(depth[first], depth[second]))
    if not np.isfinite(depth).all() or smaller <= 0:
        return float("nan")
    return 1.0 - float(depth[first : second + 1].min()) / smaller


def smallest_resolved(separation: Array, data: NDArray[np.bool_], share: float = 1.0) -> float:
    """The separation down to which this share of all pairs is distinguished, m.

    data (n,): of pairs at separations (n,), m.  NaN where not even the widest are.
    """
    reached = float("nan")
    for step in np.unique(separation)[::-1]:
        if data[separation == step].mean() < share:
            break
        reached = float(step)
    return reached


RADIUS = 1e-3
# Those of the gel of section V.C, which then serves here, too: 0.275 mm apart.
NODES, FAST_NODES = 61, 41
# Of the depth field, m.
SPACING = 0.1e-3
PAIR_SPACING = 0.05e-3
# Two spheres at one place are one, which must not be taken for two ASSUMED apart.
WIDE_MM = (0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9, 2.0, 2.5, 3.0)
SEPARATIONS = (0.0, *(1e-3 * wide for wide in WIDE_MM))
FAST_SEPARATIONS = (0.0, *(1e-3 * wide for wide in (1.2, 1.6, 2.0)))
ASSUMED = 1e-3
PAIR_DEPTH = 0.2e-3
CLEARANCE = 0.1e-3
# Pairs are pressed in four at a time, around places so far from the middle along x and y, m.
AWAY = 3.3e-3
PAIRS_AT_ONCE = 4
LAYOUTS = 3
# Fills a square evenly with few points (Roberts' R2 sequence).
PLASTIC = 1.32471795724474602596


@dataclass(frozen=True)
class Pair:
    """Two spheres: the point half way between them (x, y) m, the direction from one to the other.

    angle: from the x axis, rad.
    """

    middle: tuple[float, float]
    angle: float

    def ends(self, separation: float) -> Array:
        """(x, y) (2, 2) m of both spheres."""
        half = separation / 2 * np.array([np.cos(self.angle), np.sin(self.angle)])
        return np.asarray(np.array(self.middle) + np.array([[-1.0], [1.0]]) * half)


def cases(place: Workplace) -> Sequence[Case]:
    """Five spheres, then pairs of spheres by layout and separation."""
    seeds = tuple(range(1 if place.fast else 3))
    spheres = Case("resolution-spheres", five_spheres, (seeds,), seconds=20.0)
    if place.fast:
        return (spheres, Case("resolution-pairs", pairs_apart, (0, FAST_SEPARATIONS, seeds), 40.0))
    groups = [SEPARATIONS[first::3] for first in range(3)]
    return (
        spheres,
        *(
            Case(f"resolution-pairs-{n}-{part}", pairs_apart, (n, group, seeds), 40.0)
            for n in range(LAYOUTS)
            for part, group in enumerate(groups)
        ),
    )


def nodes_along(place: Workplace) -> int:
    """Contact nodes along the patch."""
    return FAST_NODES if place.fast else NODES


def five_spheres(place: Workplace, seeds: Sequence[int]) -> dict[str, Array]:
    """Depth fields of every reading, and how far they are off.

    At the end of the scene's pressing: `centres` (5, 2) m; `corner_xy`, `virtual_xy` (n, 2) m,
    markers at rest; `true` (rows, cols, 3) m, the displacement at material points `nodes`; by
    reading KEY `KEY_field` (rows, cols, 3) of the first seed, `KEY_all`, `KEY_near` (seeds,) m,
    RMS of the depth's error everywhere and within a radius of a sphere's centre, `KEY_missing`
    (seeds,), share of the latter that is not known, and `KEY_share` (seeds, 5), deepest point
    over the true one by sphere.
    """
    scene = replace(load_scene("resolution_spheres"), contact_nodes=nodes_along(place))
    mechanics, pattern = mechanics_of(scene, place), scene.sensor.pattern
    last = int(mechanics.frames("hold")[-1])
    frames = [*mechanics.frames("press")[2::3].tolist(), last]
    field, centres = DepthField(pattern, SPACING), np.array(scene.indenter.values["centres"])[:, :2]
    nodes = nodes_of(field.grid)
    true = true_displacement(mechanics.surface(last, pattern), nodes)
    distance = np.linalg.norm(nodes[None] - centres[:, None, None], axis=-1)
    prints = BothPrints(scene.sensor)
    results = {"centres": centres, "nodes": nodes, "true": true, **_places(prints.rest_surface)}
    for key, found in _by_reading(prints, mechanics, (frames, seeds)):
        fields = np.array([field.displacement(surface) for surface in found])
        error = true[..., 2] - fields[..., 2]
        near = error[:, (distance < RADIUS).any(axis=0)]
        results |= {
            f"{key}_field": fields[0],
            f"{key}_all": np.sqrt(np.nanmean(error**2, axis=(1, 2))),
            f"{key}_near": np.sqrt(np.nanmean(near**2, axis=1)),
            f"{key}_missing": np.isnan(near).mean(axis=1),
            f"{key}_share": np.array(
                [[_deepest(f, d) / _deepest(true, d) for d in distance] for f in fields]
            ),
        }
    return results


def pairs_apart(
    place: Workplace, layout: int, separations: Sequence[float], seeds: Sequence[int]
) -> dict[str, Array]:
    """The dip between two spheres, by separation.

    `separation` (S,) m; `true` (S, 4), dip of the marker surface itself; by reading KEY
    `KEY_dip` (S, 4, seeds).
    """
    results: dict[str, list[Array]] = {}
    prints: BothPrints | None = None
    for separation in separations:
        scene = replace(pair_scene(layout, separation), contact_nodes=nodes_along(place))
        mechanics, pattern = mechanics_of(scene, place), scene.sensor.pattern
        prints = prints or BothPrints(scene.sensor)
        field = DepthField(pattern, PAIR_SPACING)
        lines = [
            line_through(np.array(pair.middle), pair.angle, separation or ASSUMED)
            for pair in pairs_of(layout, pattern.pitch)
        ]
        last = len(mechanics) - 1
        moved = mechanics.surface(last, pattern)
        dips = [dip_between(-true_displacement(moved, line)[..., 2]) for line in lines]
        results.setdefault("true", []).append(np.array(dips))
        frames = [*mechanics.frames("press").tolist(), last]
        for key, found in _by_reading(prints, mechanics, (frames, seeds)):
            depths = [field.depth(surface) for surface in found]
            measured = [
                [dip_between(sampled(field.grid, depth, line)) for depth in depths]
                for line in lines
            ]
            results.setdefault(f"{key}_dip", []).append(np.array(measured))
    return {"separation": np.array(separations), **{k: np.array(v) for k, v in results.items()}}


def pairs_of(layout: int, pitch: float) -> tuple[Pair, ...]:
    """Four pairs at places and in directions that differ in how they lie to the gridlines."""
    pairs = []
    for number in range(PAIRS_AT_ONCE):
        index = layout * PAIRS_AT_ONCE + number
        sides = AWAY * np.array([1 - 2 * (number % 2), 1 - 2 * (number // 2)])
        within = (0.5 + (index + 1) / np.array([PLASTIC, PLASTIC**2])) % 1
        x, y = ((np.round(sides / pitch) + within - 0.5) * pitch).tolist()
        turn = (index * LAYOUTS * 5 + layout) % (LAYOUTS * PAIRS_AT_ONCE)
        pairs.append(Pair((x, y), np.pi * turn / (LAYOUTS * PAIRS_AT_ONCE)))
    return tuple(pairs)


def pair_scene(layout: int, separation: float) -> Scene:
    """The gel of the five spheres under four pairs of them, PAIR_DEPTH deep.

    They lie on a cap around the gel's, so that all touch at once.
    """
    scene = load_scene("resolution_spheres")
    elastomer, surface = scene.sensor.elastomer, scene.sensor.pattern.surface
    radius = surface.radius + elastomer.shading_layer.thickness + RADIUS
    pairs = pairs_of(layout, scene.sensor.pattern.pitch)
    xy = np.concatenate([pair.ends(separation)[: 2 if separation else 1] for pair in pairs])
    z = np.sqrt(radius**2 - (xy**2).sum(axis=1)) - radius
    centres = tuple(map(tuple, np.column_stack([xy, z]).tolist()))
    down = MoveBy((0.0, 0.0, -PAIR_DEPTH - CLEARANCE))
    return replace(
        scene,
        name=f"pairs-{layout}-{1e6 * separation:.0f}um",
        indenter=replace(scene.indenter, values={"radius": RADIUS, "centres": centres}),
        start=Start(Touch((0.0, 0.0), CLEARANCE)),
        motion=(Phase("press", 3, down, "linear"), Phase("hold", 1, Hold())),
    )


def _by_reading(
    prints: BothPrints, mechanics: Mechanics, course: tuple[Sequence[int], Sequence[int]]
) -> Iterator[tuple[str, list[Surface]]]:
    """Key and surfaces, one for each noise, of the last frame by reading; course: frames, seeds."""
    frames, seeds = course
    last = frames[-1]
    courses = list(prints.courses(mechanics, frames, seeds))
    exact = Course("", 0, [prints.rest_surface], {last: prints.true_surface(mechanics, last)})
    for reading in READINGS:
        found = [course.surfaces[last] for course in reading.courses(courses, exact)]
        yield reading.key, [reading.choose(surface) for surface in found]


def _places(rest: Surface) -> dict[str, Array]:
    virtual = rest.row_position, rest.col_position
    return {
        "corner_xy": rest.position[..., :2].reshape(-1, 2),
        "virtual_xy": np.concatenate([points[..., :2].reshape(-1, 2) for points in virtual]),
    }


def _deepest(displacement: Array, distance: Array) -> float:
    """Largest depth (rows, cols, 3) within a radius of a sphere, m; distance (rows, cols) m."""
    return float(np.nanmax(-displacement[distance < RADIUS][:, 2]))
