"""Section V.B: spheres fitted to the markers under steel balls of 10 to 20 mm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import least_squares

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.scenes.description import Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.lab import Arrays, Lab, Workplace, mechanics_of
from paper.page import TRUE_COLOUR, Page, figures, look, panels
from paper.readings import DOTS, MEASURED, READINGS, BothPrints, Reading, name_of

Array = NDArray[np.float64]

TITLE = "V.B: Precision: spheres fitted to balls"
LEAST_POINTS = 4
# In units of the points' spread; so flat that no ball of the experiment comes near to it.
FLATTEST = 1e3


@dataclass(frozen=True)
class SphereFit:
    """centre (3,) and diameter, in the points' unit; rms: of the points' distances from it.

    count: points.  NaN throughout where the points bear no sphere.
    """

    centre: Array
    diameter: float
    rms: float
    count: int


def fit_sphere(points: Array) -> SphereFit:
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


def _algebraic(points: Array) -> Array | None:
    """Centre and radius from the linear equations |p|^2 = 2 c . p + r^2 - |c|^2."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    solution, _, rank, _ = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)
    if rank < design.shape[1]:
        return None
    squared = solution[3] + solution[:3] @ solution[:3]
    return np.array([*solution[:3], np.sqrt(squared)])


def _distances(sphere: Array, points: Array) -> Array:
    return np.asarray(np.linalg.norm(points - sphere[:3], axis=1) - sphere[3])


def _gradient(sphere: Array, points: Array) -> Array:
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
# A difference is clear from so many of its standard errors on.
CLEAR = 2.0


def run(lab: Lab, page: Page) -> None:
    """Press the balls, fit spheres, and report."""
    diameters = FAST_DIAMETERS_MM if lab.fast else DIAMETERS_MM
    positions = (0,) if lab.fast else tuple(range(len(PLACES)))
    results = lab.compute(fit_balls, [(diameter, positions) for diameter in diameters])
    fits = {reading: BallFits.from_results(results, reading) for reading in READINGS}
    layer = load_scene("ball:10mm").sensor.elastomer.shading_layer.thickness
    page.prose("balls", "setup", share=DEPTH_SHARE, layer=1e3 * layer)
    page.figure(_draw(fits), "balls.diameters")
    _table(fits, layer, page)
    claims({reading.key: fit for reading, fit in fits.items()}, page)
    page.departures("balls")


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
        contacts = prints.contacts(mechanics_of(scene, place), FRAMES, seeds)
        rows.append(
            {
                key: [fit_sphere(deep_points(one.rest, one.pressed)) for one in each]
                for key, each in contacts.items()
            }
        )
    arrays: dict[str, NDArray[np.generic]] = {"ball": np.array(diameter_mm / 1000)}
    for key in rows[0]:
        for name in ("diameter", "rms", "count"):
            values = [[getattr(fit, name) for fit in row[key]] for row in rows]
            arrays[f"{key}_{name}"] = np.array(values)
    return arrays


def deep_points(rest: Surface, pressed: Surface) -> Array:
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


def _all_points(surface: Surface) -> Array:
    parts = surface.position, surface.row_position, surface.col_position
    return np.concatenate([part.reshape(-1, 3) for part in parts])


@dataclass(frozen=True)
class BallFits:
    """Fits of one reading; ball (B,) diameters in m, others (B, presses).

    diameter, rms: m; count: of markers; exact: diameter fitted to the true places of the markers
    that the reading takes, m.
    """

    ball: Array
    diameter: Array
    rms: Array
    count: Array
    exact: Array

    @classmethod
    def from_results(cls, results: Sequence[Arrays], reading: Reading) -> BallFits:
        """From the results of `fit_balls`."""
        exact = "exact_corners" if reading.corners_only else "exact"
        names = (
            *(f"{reading.key}_{name}" for name in ("diameter", "rms", "count")),
            f"{exact}_diameter",
        )
        arrays = ([np.ravel(result[name]) for result in results] for name in names)
        return cls(np.array([result["ball"] for result in results]), *map(np.array, arrays))

    @property
    def from_ball(self) -> Array:
        """Fitted minus the ball's diameter, m."""
        return np.asarray(self.diameter - self.ball[:, None])

    @property
    def from_exact(self) -> Array:
        """Fitted minus the diameter that exact markers give, m."""
        return np.asarray(self.diameter - self.exact)

    def percent(self, deviation: Array) -> float:
        """Mean size of deviations, % of the ball."""
        return float(100 * np.nanmean(np.abs(deviation) / self.ball[:, None]))


def clearly_less(first: Array, second: Array, repetitions: int = 1) -> bool:
    """Whether the first of paired deviations are smaller in size, by more than chance makes them.

    The mean of |first| - |second| lies below zero by more than CLEAR of its standard errors.
    repetitions: so many presses in a row differ in noise alone and are averaged, as they share
    what place and ball do.  Presses without a fit are left out of both.
    """
    difference = (np.abs(first) - np.abs(second)).reshape(-1, repetitions).mean(axis=1)
    difference = difference[np.isfinite(difference)]
    if len(difference) < 2:
        return False
    error = float(np.std(difference, ddof=1)) / len(difference) ** 0.5
    return bool(difference.mean() < -CLEAR * error)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _table(fits: Mapping[Reading, BallFits], layer: float, page: Page) -> None:
    rows = []
    for reading, fit in fits.items():
        off = fit.from_ball, fit.from_ball - 2 * layer, fit.from_exact
        cells = (
            f"{np.mean(fit.count):.0f}",
            *figures("{:.2f}", *(fit.percent(deviation) for deviation in off)),
            *figures("{:.3f}", 1e3 * _rms(fit.from_exact)),
            *figures("{:.2f}", 1e6 * np.nanmean(fit.rms)),
            f"{np.isnan(fit.diameter).sum()}",
        )
        rows.append((name_of(reading), *cells))
    page.table("balls.fits", rows)


def claims(fits: Mapping[str, BallFits], page: Page) -> None:
    """Compare the paper's claims on precision with the measurement; fits by the readings' keys."""
    cmp, corners, exact = fits["cmp"], fits["cmp_corners"], fits["exact"]
    dots = min((fits[key] for key in DOTS), key=lambda fit: _rms(fit.from_exact))
    raw = [fit.percent(fit.from_ball) for fit in (cmp, dots, exact)]
    nearer = clearly_less(cmp.from_ball, dots.from_ball, REPETITIONS)
    page.claim("balls.raw", nearer, percent=raw)
    measured = [fit.percent(fit.from_exact) for fit in (cmp, dots)]
    nearer = clearly_less(cmp.from_exact, dots.from_exact, REPETITIONS)
    page.claim("balls.measured", nearer, percent=measured)
    rms = [(1e3 * _rms(fit.from_exact), float(np.mean(fit.count))) for fit in (cmp, corners)]
    nearer = clearly_less(cmp.from_exact, corners.from_exact, REPETITIONS)
    page.claim("balls.virtual", nearer, rms=rms)


def _draw(fits: Mapping[Reading, BallFits]) -> Figure:
    """Deviation from the ball, and from what exact markers give."""
    figure, axes = panels(2, 1, 5.6, sharex=True)
    for offset, reading in zip(np.linspace(-0.27, 0.27, len(MEASURED)), MEASURED, strict=True):
        fit = fits[reading]
        style = look(reading.method.key if reading.method else "cmp", hollow=reading.corners_only)
        for axis, values in zip(axes, (fit.from_ball, fit.from_exact), strict=True):
            share = 100 * values / fit.ball[:, None]
            at, label = 1e3 * fit.ball + offset, name_of(reading)
            means, spread = np.nanmean(share, axis=1), np.nanstd(share, axis=1)
            axis.errorbar(at, means, spread, **{**style, "linestyle": "none"}, label=label)
    exact = next(fit for reading, fit in fits.items() if reading.key == "exact")
    off = 100 * np.nanmean(exact.from_ball, axis=1) / exact.ball
    axes[0].plot(1e3 * exact.ball, off, color=TRUE_COLOUR, label="exact markers")
    axes[0].set_ylabel("fitted - ball,\n% of the ball")
    axes[1].set_ylabel("fitted - fit to exact\nmarkers, % of the ball")
    axes[1].set_xlabel("diameter of the ball, mm")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure
