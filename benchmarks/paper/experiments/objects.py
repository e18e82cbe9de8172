"""IV.C: five objects pressed on, and how far the markers' 3-D coordinates are off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.dense import (
    DenseStatus,
    DenseSurface,
    SurfaceInterpolator,
    grid_over,
    height_map,
)
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Chain, Measurement, all_markers, mean_absolute, score_markers, virtual
from paper.dot_tracking import ALL_METHODS
from paper.experiment import Case, Workplace
from paper.gel import mechanics_of
from paper.sequence import Exposure, RenderedSequence, error_stack, measured, with_steps_between

SCENES = (
    "contact_sphere",
    "contact_cylinder",
    "contact_cube_edge",
    "contact_hexagonal_bar",
    "contact_ring",
)
# Of the dense surface in the pictures, m.
SPACING = 1e-4


def cases(place: Workplace) -> Sequence[Case]:
    """One for each object."""
    draws = 2 if place.fast else 6
    seconds = 8.0 if place.fast else 45.0
    return [Case(name, press, (name, draws), seconds) for name in SCENES]


def press(place: Workplace, name: str, draws: int) -> dict[str, NDArray[Any]]:
    """Errors of every method over the frames of a press and at its end.

    KEY_errors (draws, 2, rows, cols, 3): of displacement and position at full press, m.
    KEY_virtual, KEY_all (draws, 4): mean absolute position errors of virtual and of all markers.
    KEY_frames (draws, F, 4): KEY_all in every frame.  KEY_counts (draws, 3): visible, found, wrong.
    """
    scene = _scene(name, fast=place.fast)
    mechanics = mechanics_of(scene, place)
    surfaces = with_steps_between(mechanics, mechanics.frames("press").tolist(), scene.sensor, 1)
    result: dict[str, NDArray[Any]] = {
        "depth": surfaces[-1].displacement[..., 2].min(),
        "normal_force": -mechanics.wrench[-1, 2],
    }
    for pattern_type in ("cmp", "dmp"):
        sequence = RenderedSequence(scene.sensor, surfaces, pattern_type)
        true = [sequence.true_surface(index) for index in range(len(sequence))]
        grids = sequence.truth(len(sequence) - 1).grids
        exposures = [sequence.exposed(draw) for draw in range(draws)]
        for method in ALL_METHODS:
            if method.pattern_type == pattern_type:
                chain = Chain(scene.sensor, method)
                data, last = _trial(chain, exposures, true, grids)
                result |= {f"{method.key}_{key}": value for key, value in data.items()}
                if method.key == "cmp":
                    result |= _pictures(scene.sensor, last.surface, surfaces[-1])
    return result


def _scene(name: str, *, fast: bool) -> Scene:
    """Rest and press of a packaged scene; the fast run solves fewer frames on fewer nodes."""
    scene = load_scene(name)
    rest, press = scene.motion[:2]
    motion = replace(rest, frames=1), replace(press, frames=3) if fast else press
    return replace(scene, motion=motion, contact_nodes=24 if fast else scene.contact_nodes)


def _trial(
    chain: Chain,
    exposures: Sequence[Exposure],
    true: Sequence[Surface],
    true_grids: Mapping[str, Grid],
) -> tuple[Mapping[str, NDArray[Any]], Measurement]:
    """What `press` finds of a method, and its measurement at full press in the first draw."""
    frames, ends = [], []
    for exposure in exposures:
        taken = list(measured(chain, exposure))
        ends.append(taken[-1])
        frames.append(
            [
                mean_absolute(all_markers(item.surface, surface))
                for item, surface in zip(taken, true, strict=True)
            ]
        )
    scores = [score_markers(end.grids, true_grids) for end in ends]
    data: dict[str, NDArray[Any]] = {
        "errors": np.stack([error_stack(end.surface, true[-1]) for end in ends]),
        "virtual": np.stack([mean_absolute(virtual(end.surface, true[-1])) for end in ends]),
        "all": np.array([of_draw[-1] for of_draw in frames]),
        "frames": np.array(frames),
        "counts": np.array([(score.visible, score.found, score.wrong) for score in scores]),
    }
    return data, ends[0]


def _pictures(
    sensor: SensorDescription, surface: Surface, true: DeformedSurface
) -> dict[str, NDArray[Any]]:
    """Dense heights at rest, measured and true, and the measured displacement, m."""
    pattern = sensor.pattern
    grid = grid_over(pattern.shape, pattern.pitch, SPACING)
    dense = SurfaceInterpolator(pattern.shape, pattern.pitch, grid).interpolate(surface)
    nodes = grid.points.reshape(grid.rows, grid.cols, 2)
    position, rest = true.at_material(nodes), DeformedSurface.rest(pattern).at_material(nodes)
    status = np.full(position.shape[:2], DenseStatus.MEASURED, np.uint8)
    exact = DenseSurface(grid, rest, position, position - rest, status)
    return {
        "extent": np.array(grid.extent),
        "rest_height": rest[..., 2].astype(np.float32),
        "height": height_map(dense).height.astype(np.float32),
        "true_height": height_map(exact).height.astype(np.float32),
        "displacement": dense.displacement.astype(np.float32),
    }
