"""IV.C: five objects are pressed on the gel; errors of the markers' 3-D coordinates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Surface
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import (
    CMP,
    CMP_PAPER,
    Chain,
    Measurement,
    Method,
    all_markers,
    found_and_wrong,
    mean_absolute,
    score_markers,
)
from paper.dot_trackers import ALL_METHODS
from paper.lab import Arrays, Lab, Workplace, mechanics_of, shortened
from paper.page import Page, figures, panels
from paper.readings import DepthField, nodes_of, true_displacement
from paper.sequence import RenderedSequence, Truth, measured, with_steps_between

TITLE = "IV.C: Five objects: 3-D coordinates of all markers"
SCENES = {
    "contact_sphere": "sphere",
    "contact_cylinder": "cylinder, lying",
    "contact_cube_edge": "cube's edge",
    "contact_hexagonal_bar": "hexagonal bar",
    "contact_ring": "ring",
}
# The paper's figure for each object, m.
LIMIT = 20e-6
# Of the dense surface in the pictures, m.
SPACING = 1e-4
# The error's colours end where so many per cent of the nodes lie beyond.
ERROR_PERCENTILE = 99.5


def run(lab: Lab, page: Page) -> None:
    """Press the five objects, and report."""
    draws = 2 if lab.fast else 6
    found = lab.compute(press, [(scene, draws) for scene in SCENES])
    results = dict(zip(SCENES.values(), found, strict=True))
    page.prose("objects", "setup")
    _table(results, page)
    page.figure(_pictures(results), "objects.contact")
    for method in (CMP, CMP_PAPER):
        claim(results, method, page)
    page.departures("objects")


def press(place: Workplace, name: str, draws: int) -> dict[str, Any]:
    """Errors of every method at the end of a press.

    depth, m, and normal_force, N, of the press.  KEY_all (draws, 4): mean absolute position error
    of all markers along x, y, z and in space, m.  KEY_counts (draws, 3): visible, found, wrong.
    true_depth, depth_field (rows, cols): true and by CMP, m.  extent (2,) m of these.
    """
    frames = {"rest": 1, "press": 3 if place.fast else None}
    scene = shortened(name, frames, fast=place.fast)
    mechanics = mechanics_of(scene, place)
    surfaces = with_steps_between(mechanics, mechanics.frames("press").tolist(), scene.sensor, 1)
    result: dict[str, Any] = {
        "depth": -float(surfaces[-1].displacement[..., 2].min()),
        "normal_force": -float(mechanics.wrench[-1, 2]),
    }
    for pattern_type in ("cmp", "dmp"):
        sequence = RenderedSequence(scene.sensor, surfaces, pattern_type)
        truth = sequence.truth(len(sequence) - 1)
        exposures = [sequence.exposed(draw) for draw in range(draws)]
        for method in ALL_METHODS:
            if method.pattern_type == pattern_type:
                chain = Chain(scene.sensor, method)
                ends = [list(measured(chain, exposure))[-1] for exposure in exposures]
                result |= _errors(method, ends, truth)
                if method is CMP:
                    result |= _depths(ends[0].surface, surfaces[-1])
    return result


def _errors(method: Method, ends: Sequence[Measurement], truth: Truth) -> dict[str, NDArray[Any]]:
    scores = [score_markers(end.grids, truth.grids) for end in ends]
    errors = [mean_absolute(all_markers(end.surface, truth.surface)) for end in ends]
    counts = [(score.visible, score.found_visible, score.wrong) for score in scores]
    return {f"{method.key}_all": np.array(errors), f"{method.key}_counts": np.array(counts)}


def _depths(surface: Surface, true: DeformedSurface) -> dict[str, NDArray[Any]]:
    field = DepthField(true.pattern, SPACING)
    return {
        "extent": np.array(field.grid.extent),
        "depth_field": field.depth(surface),
        "true_depth": -true_displacement(true, nodes_of(field.grid))[..., 2],
    }


def _table(results: Mapping[str, Arrays], page: Page) -> None:
    rows = []
    for name, data in results.items():
        pressed = f"{1e3 * data['depth']:.2f} mm, {data['normal_force']:.2g} N"
        errors = figures("{:.3g}", *(1e6 * _distance(data, method) for method in ALL_METHODS))
        rows.append((name, pressed, *errors))
    counted = (_counts(results, method) for method in ALL_METHODS)
    rows.append(("markers found / wrong numbers", "", *counted))
    page.table("objects.errors", rows, methods=[method.label for method in ALL_METHODS])


def _distance(data: Arrays, method: Method) -> float:
    return float(np.mean(data[f"{method.key}_all"][:, 3]))


def _counts(results: Mapping[str, Arrays], method: Method) -> str:
    counts = [data[f"{method.key}_counts"] for data in results.values()]
    return found_and_wrong(np.concatenate(counts))


def claim(results: Mapping[str, Arrays], method: Method, page: Page) -> None:
    """Compare the paper's figure with that of a method; results by object."""
    errors = [_distance(data, method) for data in results.values()]
    found = _counts(results, method).partition(" ")[0]
    page.claim(
        "objects.error", all(error < LIMIT for error in errors), method=method.label,
        least=1e3 * min(errors), most=1e3 * max(errors), found=found,
    )  # fmt: skip


def _pictures(results: Mapping[str, Arrays]) -> Figure:
    """A column for each object: true depth, depth by CMP, error."""
    figure, axes = panels(3, len(results), 5.8, sharex=True, sharey=True)
    deepest = 1e3 * max(float(np.nanmax(data["true_depth"])) for data in results.values())
    errors = [1e6 * (data["depth_field"] - data["true_depth"]) for data in results.values()]
    widest = float(np.nanpercentile(np.abs(np.concatenate(errors, axis=None)), ERROR_PERCENTILE))
    scales = ({"vmin": 0, "vmax": deepest}, {"cmap": "RdBu_r", "vmin": -widest, "vmax": widest})
    for column, (name, data), error in zip(axes.T, results.items(), errors, strict=True):
        width, height = 1e3 * data["extent"] / 2
        place = {"origin": "lower", "extent": (-width, width, -height, height)}
        for axis, key in zip(column[:2], ("true_depth", "depth_field"), strict=True):
            depth = axis.imshow(1e3 * data[key], **scales[0], **place)
        off = column[2].imshow(error, **scales[1], **place)
        column[0].set_title(name, fontsize=9)
    for axis, label in zip(axes[:, 0], ("true depth", "depth by CMP", "error"), strict=True):
        axis.set_ylabel(f"{label}\ny, mm")
    for axis in axes.flat:
        axis.grid(visible=False)
    figure.colorbar(depth, ax=axes[:2], label="depth, mm")
    figure.colorbar(off, ax=axes[2:], label="error, um", extend="both")
    return figure
