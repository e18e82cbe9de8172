"""Table I: how many markers a square centimetre holds, and how many of them are really measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.parts import Pattern
from cmp_tactile_simulation.hard_frames.grid_score import GridScore, join_scores, score_grid
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.library import load_scene
from paper.chain import Chain
from paper.experiment import Case, Workplace
from paper.footage import Footage
from paper.mechanics import mechanics_of
from paper.method import CMP, CMP_PAPER, Method

__all__ = ["METHODS", "STATES", "cases", "count_markers", "printed_area", "virtual_count"]

METHODS = (CMP, CMP_PAPER)
STATES = ("rest", "press")
SCENE = "ball:20mm"


def cases(place: Workplace) -> Sequence[Case]:
    """One: the prototype at rest and under a ball."""
    draws = 2 if place.fast else 10
    return [Case("prototype", count_markers, (SCENE, draws), 8.0 if place.fast else 40.0)]


def printed_area(pattern: Pattern) -> float:
    """Of all checkers that the corners belong to, laid flat, m^2."""
    return (pattern.rows + 1) * (pattern.cols + 1) * pattern.pitch**2


def virtual_count(pattern: Pattern) -> int:
    """Virtual markers of a view."""
    shape = pattern.shape
    return int(np.prod(shape.row_lines) + np.prod(shape.col_lines))


def count_markers(place: Workplace, name: str, draws: int) -> Mapping[str, NDArray[Any] | float]:
    """Markers that are measured, by method and state.

    KEY_STATE_corners, KEY_STATE_virtual (draws, 2): share measured in the two views.
    KEY_STATE_space (draws,): share of the virtual markers that are measured in 3-D.
    KEY_STATE_error, KEY_STATE_corner_error (n,): distances of measured virtual markers across their
    true gridlines and of corners from theirs, px.  corners, virtual: in all.  area, m^2.
    pitch_px: between corners, at rest.  depth, m, and normal_force, N: of the press.
    """
    scene = _scene(name, fast=place.fast)
    pattern = scene.sensor.pattern
    mechanics = mechanics_of(scene, place)
    pressed = int(mechanics.frames("hold")[-1])
    surfaces = [DeformedSurface.rest(pattern), mechanics.surface(pressed, pattern)]
    footage = Footage(scene.sensor, surfaces, "cmp")
    found: dict[str, NDArray[Any] | float] = {
        "corners": float(np.prod(pattern.shape.corners)),
        "virtual": float(virtual_count(pattern)),
        "area": printed_area(pattern),
        "pitch_px": _pitch_px(footage.truth(0).grids),
        "depth": -float(mechanics.displacement[pressed, ..., 2].min()),
        "normal_force": -float(mechanics.wrench[pressed, 2]),
    }
    for method in METHODS:
        found |= _counted(scene, footage, method, draws)
    return found


def _scene(name: str, *, fast: bool) -> Scene:
    scene = load_scene(name)
    few = {"rest": 1, "press": 2 if fast else 6, "hold": 1}
    phases = (phase for phase in scene.motion if phase.name in few)
    motion = tuple(replace(phase, frames=few[phase.name]) for phase in phases)
    return replace(scene, motion=motion, contact_nodes=24 if fast else scene.contact_nodes)


def _counted(
    scene: Scene, footage: Footage, method: Method, draws: int
) -> dict[str, NDArray[np.float64]]:
    chain = Chain(scene.sensor, method)
    told: dict[str, list[Any]] = {}
    scores: dict[str, list[GridScore]] = {state: [] for state in STATES}
    for draw in range(draws):
        exposure = footage.exposed(draw)
        chain.reset()
        chain.set_reference(exposure.rest)
        for index, state in enumerate(STATES):
            measurement = chain.measure(exposure.frames[index])
            truth = footage.truth(index).grids
            key = f"{method.key}_{state}"
            grids = measurement.grids.values()
            told.setdefault(f"{key}_corners", []).append([_corner_share(grid) for grid in grids])
            told.setdefault(f"{key}_virtual", []).append([_virtual_share(grid) for grid in grids])
            told.setdefault(f"{key}_space", []).append(_space_share(measurement.surface))
            scores[state] += [_score(grid, truth[name]) for name, grid in measurement.grids.items()]
    for state in STATES:
        score = join_scores(scores[state])
        told[f"{method.key}_{state}_error"] = list(score.measured)
        told[f"{method.key}_{state}_corner_error"] = list(score.corner)
    return {name: np.asarray(values, np.float64) for name, values in told.items()}


def _score(grid: Grid, truth: Grid) -> GridScore:
    visible = np.isfinite(truth.corners[..., 0])
    return score_grid(grid, truth, visible, visible)


def _corner_share(grid: Grid) -> float:
    return float(np.mean(grid.corner_status == Status.MEASURED))


def _virtual_share(grid: Grid) -> float:
    status = np.concatenate([grid.row_line_status.ravel(), grid.col_line_status.ravel()])
    return float(np.mean(status == Status.MEASURED))


def _space_share(surface: Surface) -> float:
    status = np.concatenate([surface.row_status.ravel(), surface.col_status.ravel()])
    return float(np.mean(status == Status.MEASURED))


def _pitch_px(grids: Mapping[str, Grid]) -> float:
    """Mean distance of neighbouring corners in both views."""
    steps = [
        np.linalg.norm(np.diff(grid.corners, axis=axis), axis=-1).ravel()
        for grid in grids.values()
        for axis in (0, 1)
    ]
    return float(np.nanmean(np.concatenate(steps)))
