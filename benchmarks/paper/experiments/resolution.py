"""IV.E: five small spheres, and the distance at which two of them can be distinguished."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.lab import Arrays, Lab, Workplace, mechanics_of
from paper.page import PAPER_COLOUR, TRUE_COLOUR, Page, figures, legend, look, panels
from paper.readings import (
    DOTS,
    MEASURED,
    READINGS,
    BothPrints,
    DepthField,
    name_of,
    nodes_of,
    sampled,
    true_displacement,
)

TITLE = "IV.E: Resolution: five small spheres, and pairs of them"
# Between two points of light that are just resolved the light falls to 73.5 % (Rayleigh).
RAYLEIGH_DIP = 0.265
# Two maxima at all, by more than noise and interpolation make of one.
LEAST_DIP = 0.05
# The line goes on so far beyond both contacts, and its points are so far apart, m.
BEYOND, STEP = 0.4e-3, 25e-6
TRUE = "true"
# Figures that differ by less are the same to claims.
ALIKE = 0.1
RADIUS = 1e-3
# Those of the gel of section V.C, which then serves here, too: 0.275 mm apart.
NODES, FAST_NODES = 61, 41
# Of the depth field, m.
SPACING, PAIR_SPACING = 0.1e-3, 0.05e-3
# Two spheres at one place are one, which must not be taken for two ASSUMED apart.
WIDE_MM = (0.6, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8, 1.9, 2.0, 2.5, 3.0)
SEPARATIONS = (0.0, *(1e-3 * wide for wide in WIDE_MM))
FAST_SEPARATIONS = (0.0, 1.2e-3, 1.6e-3, 2.0e-3)
ASSUMED = 1e-3
PAIR_DEPTH, CLEARANCE = 0.2e-3, 0.1e-3
# Pairs are pressed in four at a time, around places so far from the middle along x and y, m.
AWAY, PAIRS_AT_ONCE, LAYOUTS = 3.3e-3, 4, 3
# Fills a square evenly with few points (Roberts' R2 sequence).
PLASTIC = 1.32471795724474602596
SHOWN = (("cmp", "CMP"), ("cmp_corners", "CMP, corners only"), ("dmp_nearest", "DMP, nearest dot"))
# The part of the print that is drawn, mm.
DRAWN_MM = 5.4

Array = NDArray[np.float64]


def run(lab: Lab, page: Page) -> None:
    """Press spheres and pairs, and report."""
    seeds = tuple(range(1 if lab.fast else 3))
    (spheres,) = lab.compute(five_spheres, [(seeds,)])
    layouts = range(1 if lab.fast else LAYOUTS)
    separations = FAST_SEPARATIONS if lab.fast else SEPARATIONS
    cases = [(layout, separation, seeds) for layout in layouts for separation in separations]
    parts = lab.compute(pairs_apart, cases)
    pairs = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    page.prose("resolution", "setup")
    _sphere_table(spheres, page)
    page.figure(_draw_spheres(spheres), "resolution.spheres")
    page.prose("resolution", "pairs", dip=100 * LEAST_DIP)
    _pair_table(pairs, page)
    page.figure(_draw_dips(pairs), "resolution.pairs")
    claims(spheres, pairs, page)
    page.departures("resolution")


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


def nodes_along(place: Workplace) -> int:
    """Contact nodes along the patch."""
    return FAST_NODES if place.fast else NODES


def five_spheres(place: Workplace, seeds: Sequence[int]) -> dict[str, Array]:
    """Depth fields of every reading, and how far they are off.

    At the end of the scene's pressing: `centres` (5, 2) m; `true` (rows, cols, 3) m, the
    displacement at material points `nodes`; by reading KEY `KEY_field` (rows, cols, 3) of the first
    seed, `KEY_all`, `KEY_near` (seeds,) m, RMS of the depth's error everywhere and within a radius
    of a sphere's centre, and `KEY_share` (seeds, 5), deepest point over the true one by sphere.
    """
    scene = replace(load_scene("resolution_spheres"), contact_nodes=nodes_along(place))
    mechanics, pattern = mechanics_of(scene, place), scene.sensor.pattern
    last = int(mechanics.frames("hold")[-1])
    frames = [*mechanics.frames("press")[2::3].tolist(), last]
    field, centres = DepthField(pattern, SPACING), np.array(scene.indenter.values["centres"])[:, :2]
    nodes = nodes_of(field.grid)
    true = true_displacement(mechanics.surface(last, pattern), nodes)
    distance = np.linalg.norm(nodes[None] - centres[:, None, None], axis=-1)
    results = {"centres": centres, "nodes": nodes, "true": true}
    for key, found in BothPrints(scene.sensor).contacts(mechanics, frames, seeds).items():
        fields = np.array([field.displacement(contact.pressed) for contact in found])
        error = true[..., 2] - fields[..., 2]
        near = error[:, (distance < RADIUS).any(axis=0)]
        results |= {
            f"{key}_field": fields[0],
            f"{key}_all": np.sqrt(np.nanmean(error**2, axis=(1, 2))),
            f"{key}_near": np.sqrt(np.nanmean(near**2, axis=1)),
            f"{key}_share": np.array(
                [[_deepest(f, d) / _deepest(true, d) for d in distance] for f in fields]
            ),
        }
    return results


def pairs_apart(
    place: Workplace, layout: int, separation: float, seeds: Sequence[int]
) -> dict[str, Array]:
    """The dip between two spheres, for each of the pairs of a layout.

    `separation` (4,) m; `true` (4,), dip of the marker surface itself; by reading KEY
    `KEY_dip` (4, seeds).
    """
    scene = replace(pair_scene(layout, separation), contact_nodes=nodes_along(place))
    mechanics, pattern = mechanics_of(scene, place), scene.sensor.pattern
    field = DepthField(pattern, PAIR_SPACING)
    lines = [
        line_through(np.array(pair.middle), pair.angle, separation or ASSUMED)
        for pair in pairs_of(layout, pattern.pitch)
    ]
    last = len(mechanics) - 1
    moved = mechanics.surface(last, pattern)
    dips = [dip_between(-true_displacement(moved, line)[..., 2]) for line in lines]
    results = {"separation": np.full(len(lines), separation), TRUE: np.array(dips)}
    frames = [*mechanics.frames("press").tolist(), last]
    for key, found in BothPrints(scene.sensor).contacts(mechanics, frames, seeds).items():
        depths = [field.depth(contact.pressed) for contact in found]
        measured = [
            [dip_between(sampled(field.grid, depth, line)) for depth in depths] for line in lines
        ]
        results[f"{key}_dip"] = np.array(measured)
    return results


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


def _deepest(displacement: Array, distance: Array) -> float:
    """Largest depth (rows, cols, 3) within a radius of a sphere, m; distance (rows, cols) m."""
    return float(np.nanmax(-displacement[distance < RADIUS][:, 2]))


def resolved(pairs: Arrays, key: str, dip: float, share: float = 1.0) -> tuple[float, float]:
    """Separation, m, down to which that share of pairs is distinguished; single spheres split.

    key: of a reading, or `true`.
    """
    dips = pairs[TRUE][:, None] if key == TRUE else pairs[f"{key}_dip"]
    data = dips >= dip
    single = pairs["separation"] == 0
    return (
        smallest_resolved(pairs["separation"][~single], data[~single].all(axis=1), share),
        float(data[single].mean()) if single.any() else float("nan"),
    )


def _sphere_table(spheres: Arrays, page: Page) -> None:
    rows = []
    for reading in READINGS:
        near, everywhere = (1e6 * spheres[f"{reading.key}_{what}"] for what in ("near", "all"))
        share = spheres[f"{reading.key}_share"].mean(axis=0)
        shares = figures("{:.0f}", *(100 * share))
        errors = figures("{:.3g}", near.mean(), everywhere.mean())
        rows.append((name_of(reading), *errors, *shares))
    page.table("resolution.spheres", rows)


def _pair_table(pairs: Arrays, page: Page) -> None:
    rows = []
    labels = [(TRUE, "the marker surface itself")] + [(r.key, name_of(r)) for r in READINGS]
    for key, label in labels:
        least, split = resolved(pairs, key, LEAST_DIP)
        rayleigh = resolved(pairs, key, RAYLEIGH_DIP)[0]
        half = resolved(pairs, key, RAYLEIGH_DIP, 0.5)[0]
        rows.append((label, _mm(rayleigh), _mm(half), _mm(least), f"{100 * split:.0f} %"))
    page.table("resolution.pairs", rows, dip=100 * LEAST_DIP)


def claims(spheres: Arrays, pairs: Arrays, page: Page) -> None:
    """Compare the paper's claims with the results of spheres and pairs."""
    near = {r.key: 1e6 * float(spheres[f"{r.key}_near"].mean()) for r in MEASURED}
    least = {r.key: float(spheres[f"{r.key}_share"].mean(axis=0).min()) for r in MEASURED}
    apart = {r.key: resolved(pairs, r.key, RAYLEIGH_DIP)[0] for r in MEASURED}
    dots_near, dots_least = min(near[key] for key in DOTS), max(least[key] for key in DOTS)
    dots_apart = min(apart[key] if np.isfinite(apart[key]) else np.inf for key in DOTS)
    finer = near["cmp"] < (1 - ALIKE) * dots_near
    page.claim("resolution.finer", finer, cmp=near["cmp"], dots=dots_near)
    between = least["cmp"] > (1 + ALIKE) * dots_least
    page.claim("resolution.between", between, cmp=100 * least["cmp"], dots=100 * dots_least)
    best = apart["cmp"] < dots_apart and not apart["cmp_corners"] <= apart["cmp"]
    limit = _mm(resolved(pairs, TRUE, RAYLEIGH_DIP)[0])
    found = [_mm(value) for value in (apart["cmp"], apart["cmp_corners"], dots_apart)]
    page.claim("resolution.virtual", best, apart=found, limit=limit)


def _mm(value: float) -> str:
    return f"{1e3 * value:.1f}" if np.isfinite(value) else "none"


def _draw_spheres(spheres: Arrays) -> Figure:
    figure, axes = panels(2, len(SHOWN) + 1, 5.0, sharex=True, sharey=True)
    true, nodes = spheres[TRUE][..., 2], 1e3 * spheres["nodes"]
    deepest: dict[str, Any] = {"vmin": 0.0, "vmax": 1e3 * float(-true.min())}
    fields = {"truth": true} | {label: spheres[f"{key}_field"][..., 2] for key, label in SHOWN}
    for column, (title, field) in zip(axes.T, fields.items(), strict=True):
        depth = column[0].pcolormesh(nodes[0, :, 0], nodes[:, 0, 1], -1e3 * field, **deepest)
        error = column[1].pcolormesh(
            nodes[0, :, 0], nodes[:, 0, 1], 1e6 * (true - field), cmap="RdBu_r", vmin=-60, vmax=60
        )
        column[0].set_title(title)
        for axis in column:
            for x, y in 1e3 * spheres["centres"]:
                axis.add_patch(Circle((x, y), 1e3 * RADIUS, fill=False, linewidth=0.7))
            axis.set(xlim=(-DRAWN_MM, DRAWN_MM), ylim=(-DRAWN_MM, DRAWN_MM), aspect="equal")
            axis.grid(visible=False)
    figure.colorbar(depth, ax=axes[0], label="depth, mm")
    figure.colorbar(error, ax=axes[1], label="error, um")
    return figure


def _draw_dips(pairs: Arrays) -> Figure:
    figure, axes = panels(1, 1, 3.6)
    wide = np.unique(pairs["separation"])
    wide = wide[wide > 0]
    of = [pairs["separation"] == value for value in wide]
    true = [100 * (pairs[TRUE][rows] >= RAYLEIGH_DIP).mean() for rows in of]
    axes.plot(1e3 * wide, true, color=TRUE_COLOUR, label="marker surface itself")
    for reading in MEASURED:
        shares = [100 * (pairs[f"{reading.key}_dip"][r] >= RAYLEIGH_DIP).mean() for r in of]
        style = look(reading.method.key if reading.method else "cmp", hollow=reading.corners_only)
        axes.plot(1e3 * wide, shares, label=name_of(reading), **style)
    axes.axhline(50, color=PAPER_COLOUR, linestyle="--", linewidth=1)
    axes.set(xlabel="separation of the spheres, mm", ylabel="pairs distinguished, %")
    legend(figure, axes, 3)
    return figure
