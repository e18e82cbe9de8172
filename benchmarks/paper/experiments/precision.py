"""IV.D: a sphere under 50 N, 12 N and 50 N mm; errors of the displacements.

Also: the effect of the size of the dots.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_simulation.scenes.description import Scene
from paper.chain import (
    CMP,
    Chain,
    Method,
    found_and_wrong,
    in_contact,
    largest,
    root_mean_square,
    score_markers,
)
from paper.dot_trackers import ALL_METHODS, DMP_GRID, DMP_NEAREST, GridOrderTracker, NearestTracker
from paper.dots import DotParameters
from paper.lab import Arrays, Lab, Mechanics, Workplace, mechanics_of, shortened
from paper.page import Page, figures, panels
from paper.sequence import DOT_DIAMETER, RenderedSequence, measured, with_steps_between

TITLE = "IV.D: Precision under normal force, tangential force and torque"
# Centres that are not corrected for what bending of the surface does to them.
DMP_PLAIN = Method(
    "dmp_plain",
    "DMP, nearest dot, plain centroids",
    "dmp",
    partial(NearestTracker, parameters=DotParameters(curvature=False)),
)
METHODS = (*ALL_METHODS, DMP_PLAIN)
AXES = ("x", "y", "z")
# Diameter over pitch; whether centres are corrected, by name.
DOT_SIZES = (0.25, 0.35, 0.5, 0.65)
CENTRES = {"corrected": True, "plain": False}
# "Noticeably larger" and "significant concentration" of the paper, as we take them.
NOTICEABLE, CONCENTRATED = 1.1, 1.5

Array = NDArray[np.float64]


def run(lab: Lab, page: Page) -> None:
    """Measure under the loads, and report."""
    draws = 2 if lab.fast else 8
    cmp, dmp = lab.compute(loads, [(kind, draws) for kind in ("cmp", "dmp")])
    data: Arrays = {**cmp, **dmp}
    summaries = {method.key: Summary.from_arrays(data, method) for method in METHODS}
    force, torque = data["wrench"][:3], data["wrench"][5]
    page.prose(
        "precision", "setup", normal=-force[2], tangential=force[0], torque=1e3 * torque,
        depth=-1e3 * float(np.min(data["true"][..., 2])), share=float(np.mean(data["inside"])),
    )  # fmt: skip
    _table(summaries, page)
    page.figure(_maps(data), "precision.maps")
    if not lab.fast:
        _dots_table(lab.compute(dots, [(6,)])[0], page)
    for method in (DMP_PLAIN, DMP_NEAREST):
        claims(summaries[CMP.key], summaries[method.key], method, page)
    page.departures("precision", diameter=DOT_DIAMETER)


def loads(place: Workplace, pattern_type: str, draws: int) -> dict[str, NDArray[Any]]:
    """Displacement errors of a print's methods under all loads together, m.

    KEY_errors (draws, rows, cols, 3).  KEY_counts (draws, 3): visible, found, wrong.
    inside (rows, cols): in contact.  wrench (6,).  true (rows, cols, 3): displacement.
    reference (rows, cols, 3): corners at rest.
    """
    scene = _scene(fast=place.fast)
    mechanics = mechanics_of(scene, place)
    reference = scene.sensor.pattern.corners()
    # As small steps in the fast run as in the full one, for those that follow.
    sequence = _sequence(scene, mechanics, pattern_type, 5 if place.fast else 1)
    last = len(mechanics) - 1
    result: dict[str, NDArray[Any]] = {
        "inside": in_contact(mechanics, last, reference),
        "wrench": mechanics.wrench[last],
        "reference": reference,
        "true": mechanics.surface(last, scene.sensor.pattern).corners() - reference,
    }
    for method in METHODS:
        if method.pattern_type == pattern_type:
            result |= measure(method, scene, sequence, draws)
    return result


def dots(place: Workplace, draws: int) -> dict[str, NDArray[Any]]:
    """SIZE_CENTRES_errors and SIZE_CENTRES_counts, as in `loads`.

    Dots are numbered by the order of their grid.
    """
    scene = _scene(fast=place.fast)
    mechanics = mechanics_of(scene, place)
    result: dict[str, NDArray[Any]] = {}
    for size in DOT_SIZES:
        sequence = _sequence(scene, mechanics, "dmp", 1, dot_diameter=size)
        for centres, corrected in CENTRES.items():
            parameters = replace(DotParameters(), diameter=size, curvature=corrected)
            tracker = partial(GridOrderTracker, parameters=parameters)
            method = replace(DMP_GRID, key=f"{size:g}_{centres}", tracker=tracker)
            result |= measure(method, scene, sequence, draws)
    return result


def _scene(*, fast: bool) -> Scene:
    """The packaged scene; the fast run solves two frames on fewer nodes."""
    whole = dict.fromkeys(("rest", "press", "drag", "turn"))
    few = {"rest": 1, "press": 1, "turn": 1}
    return shortened("precision_sphere", few if fast else whole, fast=fast)


def _sequence(
    scene: Scene, mechanics: Mechanics, pattern_type: str, steps: int, **gel: float
) -> RenderedSequence:
    frames = np.flatnonzero(mechanics.phase != "rest").tolist()
    surfaces = with_steps_between(mechanics, frames, scene.sensor, steps)
    return RenderedSequence(scene.sensor, surfaces, pattern_type, **gel)


def measure(
    method: Method, scene: Scene, sequence: RenderedSequence, draws: int
) -> dict[str, NDArray[Any]]:
    """KEY_errors and KEY_counts of the last frame; nothing where noise leaves no reference."""
    truth, chain = sequence.truth(len(sequence) - 1), Chain(scene.sensor, method)
    errors = np.full((draws, *scene.sensor.pattern.shape.corners, 3), np.nan)
    counts = np.zeros((draws, 3), np.intp)
    for draw in range(draws):
        with suppress(CalibrationError):
            last = list(measured(chain, sequence.exposed(draw)))[-1]
            errors[draw] = last.surface.displacement - truth.surface.displacement
            score = score_markers(last.grids, truth.grids)
            counts[draw] = score.visible, score.found_visible, score.wrong
    return {f"{method.key}_errors": errors, f"{method.key}_counts": counts}


@dataclass(frozen=True)
class Summary:
    """Displacement errors of a method, m.

    rms, largest (3,) along x, y, z: RMS over markers and draws, mean over draws of the largest.
    concentration (3,): how many times larger the RMS is in contact than outside of it.
    counts: share of the visible markers that is found, and number of those with wrong numbers.
    """

    rms: Array
    largest: Array
    concentration: Array
    counts: str

    @classmethod
    def from_arrays(cls, data: Arrays, method: Method) -> Summary:
        """Of the results of `loads`."""
        errors, inside = data[f"{method.key}_errors"], data["inside"]
        return cls(
            root_mean_square(errors),
            np.mean([largest(draw) for draw in errors], axis=0),
            root_mean_square(errors[:, inside]) / root_mean_square(errors[:, ~inside]),
            found_and_wrong(data[f"{method.key}_counts"]),
        )

    @property
    def typical_concentration(self) -> float:
        """Geometric mean of `concentration` over the axes: z, where errors are largest, is one."""
        return float(np.exp(np.log(self.concentration).mean()))


def split_of(errors: Array) -> tuple[float, float]:
    """What all draws of noise share of errors (draws, rows, cols, 3), and their spread, RMS, m.

    Two draws or more; markers missing in one are left out.
    """
    known = errors[:, np.isfinite(errors).all(axis=(0, -1))]
    spread = known.var(axis=0, ddof=1).sum(axis=-1).mean()
    # The mean over draws still holds a share of the noise.
    shared = (known.mean(axis=0) ** 2).sum(axis=-1).mean() - spread / len(known)
    return float(np.sqrt(max(shared, 0.0))), float(np.sqrt(spread))


def _table(summaries: Mapping[str, Summary], page: Page) -> None:
    ours = np.linalg.norm(summaries[CMP.key].rms)
    rows = []
    for method in METHODS:
        found = summaries[method.key]
        errors = figures("{:.3g}", *(1e6 * found.rms), *(1e6 * found.largest))
        (ratio,) = figures("{:.2f}", np.linalg.norm(found.rms) / ours)
        rows.append((method.label, *errors, ratio, _times(found.concentration), found.counts))
    page.table("precision.loads", rows)


def _dots_table(data: Arrays, page: Page) -> None:
    rows = []
    for size, centres in product(DOT_SIZES, CENTRES):
        errors = data[f"{size:g}_{centres}_errors"]
        both = float(np.linalg.norm(root_mean_square(errors)))
        counts = found_and_wrong(data[f"{size:g}_{centres}_counts"])
        parts = figures("{:.3g}", *(1e6 * value for value in (*split_of(errors), both)))
        rows.append((f"{size:g}", centres, *parts, counts))
    page.table("precision.dots", rows, method=DMP_GRID.label, diameter=DOT_DIAMETER)


def claims(ours: Summary, dots: Summary, method: Method, page: Page) -> None:
    """Compare the paper's claims on CMP and DMP with ours."""
    values = {"method": method.label}
    for k, axis in enumerate(AXES):
        pair = np.array([[ours.rms[k], dots.rms[k]], [ours.largest[k], dots.largest[k]]])
        worse = (pair[:, 1] >= NOTICEABLE * pair[:, 0]).all()
        page.claim("precision.axis", worse, axis=axis, um=1e6 * pair, **values)
    values |= {"ours": _times(ours.concentration), "dots": _times(dots.concentration)}
    concentrated = dots.typical_concentration >= CONCENTRATED
    page.claim("precision.concentrated", concentrated, **values)
    page.claim("precision.uniform", _unevenness(ours) < _unevenness(dots), **values)


def _unevenness(summary: Summary) -> float:
    return float(abs(np.log(summary.typical_concentration)))


def _times(ratios: Array) -> str:
    return ", ".join(f"{ratio:.2f}" for ratio in ratios)


def _maps(data: Arrays) -> Figure:
    """A row for each print, a column for each axis with one scale."""
    figure, axes = panels(2, 3, 5.6, sharex=True, sharey=True)
    x, y = 1e3 * data["reference"][0, :, 0], 1e3 * data["reference"][:, 0, 1]
    means = [1e6 * data[f"{method.key}_errors"].mean(axis=0) for method in (CMP, DMP_PLAIN)]
    for k, name in enumerate(AXES):
        widest = float(np.nanmax([np.abs(mean[..., k]) for mean in means]))
        for axis, mean, label in zip(axes[:, k], means, ("CMP", "DMP, plain"), strict=True):
            drawn = axis.pcolormesh(x, y, mean[..., k], cmap="RdBu_r", vmin=-widest, vmax=widest)
            axis.contour(x, y, data["inside"], levels=[0.5], colors="black", linewidths=1.2)
            axis.set(title=f"{label}, {name}", aspect="equal")
            axis.grid(visible=False)
        figure.colorbar(drawn, ax=axes[:, k], location="bottom", label=f"error in {name}, um")
    return figure
