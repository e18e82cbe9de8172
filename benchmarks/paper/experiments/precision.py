"""IV.D: a sphere under 50 N, 12 N and 50 N mm, and how far the displacements are off.

Beside the loads: what the dots' size does.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Chain, Method, displacement_error, in_contact, score_markers
from paper.dot_tracking import ALL_METHODS, DMP_GRID, GridOrderTracker, NearestTracker
from paper.dots import DotParameters
from paper.experiment import Case, Workplace
from paper.gel import mechanics_of
from paper.sequence import Exposure, RenderedSequence, Truth, measured, steps_to, with_steps_between

PHASES = ("press", "drag", "turn")
# Centres that are not corrected for what bending of the surface does to them.
DMP_PLAIN = Method(
    "dmp_plain",
    "DMP, nearest dot, plain centroids",
    "dmp",
    partial(NearestTracker, parameters=DotParameters(curvature=False)),
)
METHODS = (*ALL_METHODS, DMP_PLAIN)
# Diameter over pitch.
DOT_SIZES = (0.25, 0.35, 0.5, 0.65)
# Whether centres are corrected, by name.
CENTRES = {"corrected": True, "plain": False}


def cases(place: Workplace) -> Sequence[Case]:
    """The loads, and the dots' size."""
    if place.fast:
        return [
            Case("loads_cmp", loads, ("cmp", 2), 50.0),
            Case("loads_dmp", loads, ("dmp", 2), 15.0),
        ]
    return [
        # The first solves the contact, which the others find solved.
        Case("loads_cmp", loads, ("cmp", 8), 150.0),
        Case("loads_dmp", loads, ("dmp", 8), 50.0),
        Case("dots", dots, (6,), 40.0),
    ]


def loads(place: Workplace, pattern_type: str, draws: int) -> dict[str, NDArray[Any]]:
    """Displacement errors of a print's methods at the end of each of P phases, m.

    KEY_errors (draws, P, rows, cols, 3).  KEY_counts (draws, P, 3): visible, found, wrong.
    inside (P, rows, cols): in contact.  node (N, 2) m at rest, contact (P, N).  wrench (P, 6).
    true (P, rows, cols, 3): displacement.
    """
    scene = _scene(fast=place.fast)
    mechanics = mechanics_of(scene, place)
    frames = [int(index) for index in np.arange(len(mechanics)) if mechanics.phase[index] in PHASES]
    # As small steps as in the full run, for those that track from frame to frame.
    steps = 5 if place.fast else 1
    surfaces = with_steps_between(mechanics, frames, scene.sensor, steps)
    ends = [int(mechanics.frames(phase)[-1]) for phase in PHASES if phase in mechanics.phase]
    judged = [(frames.index(end) + 1) * steps - 1 for end in ends]
    reference = scene.sensor.pattern.corners()
    result: dict[str, NDArray[Any]] = {
        "phase": mechanics.phase[ends],
        "inside": np.stack([in_contact(mechanics, end, reference) for end in ends]),
        "node": mechanics.node_position[:, :2],
        "contact": mechanics.contact[ends],
        "wrench": mechanics.wrench[ends],
        "reference": reference,
        "true": np.stack([surfaces[k].corners() - reference for k in judged]),
    }
    return result | _Trials(scene.sensor, surfaces, pattern_type, judged).all_methods(draws)


def dots(place: Workplace, draws: int) -> dict[str, NDArray[Any]]:
    """SIZE_CENTRES_errors and SIZE_CENTRES_counts, as in `loads`, under all loads.

    Dots are numbered by the order of their grid.
    """
    scene = _scene(fast=place.fast)
    mechanics = mechanics_of(scene, place)
    surfaces = steps_to(mechanics, len(mechanics) - 1, scene.sensor, 1)
    result: dict[str, NDArray[Any]] = {}
    for size in DOT_SIZES:
        trials = _Trials(scene.sensor, surfaces, "dmp", [0], dot_diameter=size)
        for centres, corrected in CENTRES.items():
            parameters = replace(DotParameters(), diameter=size, curvature=corrected)
            tracker = partial(GridOrderTracker, parameters=parameters)
            data = trials.measure(replace(DMP_GRID, tracker=tracker), draws)
            result |= {f"{size:g}_{centres}_{name}": value for name, value in data.items()}
    return result


def _scene(*, fast: bool) -> Scene:
    """The packaged scene; the fast run solves two frames on fewer nodes."""
    scene = load_scene("precision_sphere")
    if not fast:
        return scene
    rest, press, _, turn, _ = scene.motion
    motion = tuple(replace(phase, frames=1) for phase in (rest, press, turn))
    return replace(scene, motion=motion, contact_nodes=24)


class _Trials:
    """Methods on the rendered sequence of their print, judged in some of its frames."""

    def __init__(
        self,
        sensor: SensorDescription,
        surfaces: Sequence[DeformedSurface],
        pattern_type: str,
        judged: Sequence[int],
        **gel: float,
    ) -> None:
        self.methods = [method for method in METHODS if method.pattern_type == pattern_type]
        self.sequence = RenderedSequence(sensor, surfaces, pattern_type, **gel)
        self._sensor = sensor
        self._truths: dict[int, Truth] = {index: self.sequence.truth(index) for index in judged}
        self._exposures: dict[int, list[Exposure]] = {}

    def all_methods(self, draws: int) -> dict[str, NDArray[Any]]:
        """What `measure` finds of every method of the print, named KEY_..."""
        data = {method.key: self.measure(method, draws) for method in self.methods}
        return {
            f"{key}_{name}": value for key, each in data.items() for name, value in each.items()
        }

    def measure(self, method: Method, draws: int) -> dict[str, NDArray[Any]]:
        """errors (draws, P, rows, cols, 3), counts (draws, P, 3)."""
        if draws not in self._exposures:
            self._exposures[draws] = [self.sequence.exposed(draw) for draw in range(draws)]
        errors, counts = self.errors(method, self._exposures[draws])
        return {"errors": errors, "counts": counts}

    def errors(
        self, method: Method, exposures: Sequence[Exposure]
    ) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        """Displacement errors (draws, P, rows, cols, 3), m, and counts (draws, P, 3)."""
        chain = Chain(self._sensor, method)
        pairs = [self._in_draw(chain, exposure) for exposure in exposures]
        return np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])

    def _in_draw(
        self, chain: Chain, exposure: Exposure
    ) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
        shape = self._sensor.pattern.shape.corners
        errors = np.full((len(self._truths), *shape, 3), np.nan, np.float32)
        counts = np.zeros((len(self._truths), 3), np.intp)
        with suppress(ReferenceFramesError):  # in much noise: then nothing is measured
            for index, item in enumerate(measured(chain, exposure)):
                if index in self._truths:
                    row, truth = list(self._truths).index(index), self._truths[index]
                    errors[row] = displacement_error(item.surface, truth.surface)
                    score = score_markers(item.grids, truth.grids)
                    counts[row] = score.visible, score.found, score.wrong
        return errors, counts
