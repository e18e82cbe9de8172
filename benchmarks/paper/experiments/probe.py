"""Section V.C: share of a small probe's depth that the markers show, at 25 points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import binomtest

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Phase, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.lab import Arrays, Lab, Workplace, mechanics_of
from paper.page import Page, panels
from paper.readings import DOTS, READINGS, BothPrints, Contact, name_of, true_displacement

TITLE = "V.C: Response to a probe of 0.6 mm"
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


def dents_of(contact: Contact, material: Surface) -> Dents:
    """Depths of all known markers of a contact, against the gel at rest.

    material: the exact markers at rest, whose x and y are the material coordinates.
    """
    depths, places = [], []
    for name in ("position", "row_position", "col_position"):
        rest, pressed = getattr(contact.rest, name), getattr(contact.pressed, name)
        depths.append((rest - pressed)[..., 2].ravel())
        places.append(getattr(material, name)[..., :2].reshape(-1, 2))
    depth, xy = np.concatenate(depths), np.concatenate(places)
    known = np.isfinite(depth)
    return Dents(xy[known], depth[known])


def captured_depth(
    dents: Dents, around: tuple[float, float], reach: float, neighbourhood: Neighbourhood
) -> tuple[float, float]:
    """Depth of the deepest marker, m, and deepest place of the polynomial through its neighbours.

    Of the markers within `reach`, m, of a place (x, y) m.
    """
    near = np.linalg.norm(dents.xy - around, axis=1) <= reach
    if not near.any():
        return float("nan"), float("nan")
    deepest = int(np.argmax(np.where(near, dents.depth, -np.inf)))
    fitted = fitted_depth(dents, dents.xy[deepest], neighbourhood)
    return float(dents.depth[deepest]), fitted


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
# "Significantly" of the paper: chance alone would do as well less often than this.
CHANCE = 0.05
# The deepest marker is sought so far from the probe, m: nothing else presses.
REACH = 1.2e-3
SPACING = 0.05e-3
# The points lie on nodes of these as well.
FAST_NODES = 41

# Three rows of three corners, or so many markers on the gridlines.
NEAREST = 9
SHOWN = {
    "cmp": "CMP, with virtual markers",
    "cmp_paper": "CMP, the paper's algorithm",
    "cmp_corners": "CMP, corners only",
    "dmp_nearest": "DMP, nearest dot",
}
LIMIT_MM = 6.0


def run(lab: Lab, page: Page) -> None:
    """Press all points, in the fast run the nine of one quarter, which the others mirror."""
    points = probe_points()
    if lab.fast:
        points = tuple((x, y) for x, y in points if x <= 0 and y <= 0)
    seeds = tuple(range(1 if lab.fast else 3))
    parts = lab.compute(captured_at, [(point, seeds) for point in points])
    data = {name: np.array([part[name] for part in parts]) for name in parts[0]}
    deepest = 1e3 * data["true"]
    page.prose(
        "probe", "setup", pressed=1e3 * PRESSED, least=deepest.min(), most=deepest.max(),
        zone=HIGH_RESPONSE,
    )  # fmt: skip
    _depth_table(data, page)
    page.figure(_maps(data), "probe.maps", zone=HIGH_RESPONSE)
    page.prose("probe", "polynomial")
    _gain_table(data, page)
    claims(data, page)
    page.departures("probe", points=len(points))


def probe_points() -> tuple[tuple[float, float], ...]:
    """Where the scene presses, (x, y) m, in order."""
    goals = [phase.goal for phase in load_scene("probe").motion]
    return tuple(goal.at for goal in goals if isinstance(goal, Touch))


def captured_at(
    place: Workplace, point: tuple[float, float], seeds: Sequence[int]
) -> dict[str, Any]:
    """What every reading captures of the probe at a point.

    `points` (2,) m; `true` m, deepest place of the marker surface; `corner_xy` (n, 2) m;
    by reading KEY, each (seeds,) m: `KEY_depth` of the deepest marker, `KEY_square` and
    `KEY_nearest` of the quadratic through its neighbours.
    """
    scene = point_scene(point)
    if place.fast:
        scene = replace(scene, contact_nodes=FAST_NODES)
    mechanics, pattern = mechanics_of(scene, place), scene.sensor.pattern
    prints = BothPrints(scene.sensor)
    frames = [n for n, phase in enumerate(mechanics.phase) if phase.startswith("press")]
    data: dict[str, Any] = {
        "points": point,
        "true": _true_depth(mechanics.surface(frames[-1], pattern), point),
        "corner_xy": pattern.corners()[..., :2].reshape(-1, 2),
    }
    for key, contacts in prints.contacts(mechanics, frames, seeds).items():
        dents = (dents_of(contact, prints.rest) for contact in contacts)
        depths = [_depths(each, point, pattern.pitch) for each in dents]
        data |= {f"{key}_{name}": np.array([d[name] for d in depths]) for name in depths[0]}
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


def _depths(dents: Dents, point: tuple[float, float], pitch: float) -> Mapping[str, float]:
    """Depths of the dent at a point, m, by the way they are found."""
    square = Neighbourhood(pitch)
    depth, by_square = captured_depth(dents, point, REACH, square)
    _, by_nearest = captured_depth(dents, point, REACH, replace(square, nearest=NEAREST))
    return {"depth": depth, "square": by_square, "nearest": by_nearest}


def responses(points: Arrays, key: str) -> tuple[float, float, float]:
    """Mean depth, m; share of points in the paper's zone; in that of the marker surface."""
    depth = points[f"{key}_depth"]
    of_true = depth >= HIGH_RESPONSE * points["true"][:, None]
    of_probe = depth >= HIGH_RESPONSE * PRESSED
    return float(depth.mean()), float(of_probe.mean()), float(of_true.mean())


def gain(points: Arrays, key: str, way: str) -> tuple[float, float]:
    """Mean gain over the deepest marker; RMS of what is left to the marker surface's depth, m."""
    fitted = points[f"{key}_{way}"]
    left = fitted - points["true"][:, None]
    return float((fitted - points[f"{key}_depth"]).mean()), float(np.sqrt((left**2).mean()))


def _depth_table(points: Arrays, page: Page) -> None:
    rows = []
    for reading in READINGS:
        mean, paper_zone, true_zone = responses(points, reading.key)
        share = points[f"{reading.key}_depth"] / points["true"][:, None]
        shares = (mean / PRESSED, share.mean(), share.min(), paper_zone, true_zone)
        rows.append((name_of(reading), f"{1e3 * mean:.3f}", *(f"{value:.0%}" for value in shares)))
    page.table("probe.depths", rows)


def _gain_table(points: Arrays, page: Page) -> None:
    rows = []
    for reading in READINGS:
        cells = [name_of(reading), f"{1e3 * gain(points, reading.key, 'depth')[1]:.3f}"]
        for way in ("square", "nearest"):
            more, left = gain(points, reading.key, way)
            cells.append(f"{1e3 * more:+.3f} ({1e3 * left:.3f})")
        rows.append(cells)
    page.table("probe.gains", rows)


def claims(points: Arrays, page: Page) -> None:
    """Compare the paper's claims with the results of all points."""
    ours = responses(points, "cmp")
    dots = np.max([responses(points, key) for key in DOTS], axis=0)
    of_probe = np.full_like(points["true"], PRESSED)
    nearer = abs(PRESSED - ours[0]) < abs(PRESSED - dots[0])
    page.claim("probe.depth", nearer, cmp=1e3 * ours[0], dots=1e3 * dots[0])
    true = float((points["true"] >= HIGH_RESPONSE * PRESSED).mean())
    for n, (name, full) in enumerate((("zone", of_probe), ("true_zone", points["true"])), 1):
        more = all(significantly_more(points, key, full) for key in DOTS)
        page.claim(f"probe.{name}", more, cmp=ours[n], dots=dots[n], true=true)
    for way, label in (("square", "a square of one pitch"), ("nearest", "the nine nearest")):
        own, best = gain(points, "cmp", way)[0], max(gain(points, key, way)[0] for key in DOTS)
        # A loss of depth is not a gain, even if DMP loses more.
        larger = own > max(best, 0.0)
        page.claim("probe.gain", larger, markers=label, cmp=1e3 * own, dots=1e3 * best)


def significantly_more(points: Arrays, dots: str, full: Array) -> bool:
    """Whether more points are in the zone with CMP than with a DMP, by more than chance.

    full (P,) m: depth that the zone is a share of.  Sign test over the points at which one of both
    is in the zone by the mean depth of all noises, and the other is not.
    """
    ours, theirs = (
        points[f"{key}_depth"].mean(axis=1) >= HIGH_RESPONSE * full for key in ("cmp", dots)
    )
    won, lost = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    if not won + lost:
        return False
    return bool(binomtest(won, won + lost, alternative="greater").pvalue < CHANCE)


def _maps(points: Arrays) -> Figure:
    """Depth of the deepest marker at each point, one panel for each method."""
    figure, axes = panels(2, 2, 7.6, sharex=True, sharey=True)
    x, y = 1e3 * points["points"].T
    true = points["true"]
    low = 1e3 * min(float(points[f"{key}_depth"].min()) for key in SHOWN)
    image: Any = None
    for axis, (key, title) in zip(axes.flat, SHOWN.items(), strict=True):
        depth = points[f"{key}_depth"].mean(axis=1)
        axis.plot(*(1e3 * points["corner_xy"][0].T), ".", color="#bbbbbb", markersize=1.5)
        image = axis.scatter(x, y, c=1e3 * depth, s=130, vmin=0.95 * low, vmax=1e3 * true.max())
        high = depth >= HIGH_RESPONSE * true
        axis.scatter(x[high], y[high], s=230, facecolors="none", edgecolors="black", linewidths=1.1)
        axis.set_title(f"{title}: {high.sum()} of {len(high)}, mean {1e3 * depth.mean():.3f} mm")
        axis.set(xlim=(-LIMIT_MM, LIMIT_MM), ylim=(-LIMIT_MM, LIMIT_MM), aspect="equal")
        axis.grid(visible=False)
    figure.supxlabel("x, mm")
    figure.supylabel("y, mm")
    figure.colorbar(image, ax=axes, label="depth of the deepest marker, mm", shrink=0.8)
    return figure
