"""IV.D: a sphere under 50 N, 12 N and 50 N mm, and how far the displacements are off.

Beside the loads: why the methods differ, or do not.  That is asked of noise, of the dots' size, of
contacts that bend the surface more sharply, and of a gel that moves without any distortion.
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
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Chain, Method, displacement_error, in_contact, score_markers
from paper.dot_tracking import ALL_METHODS, DMP_GRID, GridOrderTracker, NearestTracker
from paper.dots import DotParameters
from paper.experiment import Case, Workplace
from paper.gel import mechanics_of
from paper.sequence import Exposure, RenderedSequence, Truth, measured, steps_to, with_steps_between

PRINTS = ("cmp", "dmp")
PHASES = ("press", "drag", "turn")
# Centres that are not corrected for what bending of the surface does to them.
DMP_PLAIN = Method(
    "dmp_plain",
    "DMP, nearest dot, plain centroids",
    "dmp",
    partial(NearestTracker, parameters=DotParameters(curvature=False)),
)
METHODS = (*ALL_METHODS, DMP_PLAIN)
# Standard deviation of the camera's noise, grey levels; the default camera has 1.
NOISE = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
# Diameter over pitch.
DOT_SIZES = (0.25, 0.35, 0.5, 0.65)
# Whether centres are corrected, by name.
CENTRES = {"corrected": True, "plain": False}
# Scenes with objects that are curved more sharply than the sphere of 15 mm, by their radius in mm.
SHARPER = {
    "contact_sphere": 5.0,
    "contact_ring": 1.0,
    "contact_cube_edge": 0.5,
    "contact_hexagonal_bar": 0.4,
}
# Of the whole gel, m: as far as under the loads, and away from whole pixels.
SHIFT = (-0.11e-3, 0.07e-3, -0.6e-3)
# Frames from rest to a state that is reached on a straight way.
APPROACH = 6


def cases(place: Workplace) -> Sequence[Case]:
    """The loads, and three questions about them."""
    if place.fast:
        return [
            Case("loads_cmp", loads, ("cmp", 2), 50.0),
            Case("loads_dmp", loads, ("dmp", 2), 15.0),
            Case("contact_hexagonal_bar", sharper, ("contact_hexagonal_bar", 2), 12.0),
            Case("moved", moved, (2,), 8.0),
        ]
    return [
        # The first solves the contact, which the others find solved.
        Case("loads_cmp", loads, ("cmp", 8), 150.0),
        Case("loads_dmp", loads, ("dmp", 8), 50.0),
        *(Case(name, sharper, (name, 8), 30.0) for name in SHARPER),
        Case("moved", moved, (8,), 20.0),
        Case("dots", dots, (6,), 40.0),
        Case("noise", noise, (6,), 90.0),
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


def noise(place: Workplace, draws: int) -> dict[str, NDArray[Any]]:
    """KEY (levels, draws, rows, cols, 3): displacement errors under all loads by noise, m."""
    scene = _scene(fast=place.fast)
    mechanics = mechanics_of(scene, place)
    surfaces = steps_to(mechanics, len(mechanics) - 1, scene.sensor, APPROACH)
    stacks: dict[str, list[NDArray[np.float32]]] = {method.key: [] for method in METHODS}
    for pattern_type in PRINTS:
        trials = _Trials(scene.sensor, surfaces, pattern_type, [len(surfaces) - 1])
        for level in NOISE:
            camera = CameraSettings(read_noise=level)
            exposures = [trials.sequence.exposed(draw, camera) for draw in range(draws)]
            for method in trials.methods:
                errors = trials.errors(method, exposures)[0]
                stacks[method.key].append(errors[:, 0])
    inside = in_contact(mechanics, len(mechanics) - 1, scene.sensor.pattern.corners())
    return {"inside": inside, **{key: np.stack(stack) for key, stack in stacks.items()}}


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


def moved(place: Workplace, draws: int) -> dict[str, NDArray[Any]]:
    """As `loads`, of a gel that is shifted as a whole: nothing is distorted, nothing touches."""
    sensor = _scene(fast=place.fast).sensor
    rest = DeformedSurface.rest(sensor.pattern)
    shifts = [np.full(rest.displacement.shape, SHIFT) * share for share in (0.5, 1.0)]
    surfaces = [replace(rest, displacement=shift) for shift in shifts]
    return _all_prints(sensor, surfaces, draws)


def sharper(place: Workplace, name: str, draws: int) -> dict[str, NDArray[Any]]:
    """As `loads`, of the full press of another scene; P is 1."""
    scene = load_scene(name)
    rest, press = (replace(phase, frames=1) for phase in scene.motion[:2])
    press = replace(press, frames=4)
    nodes = 24 if place.fast else scene.contact_nodes
    scene = replace(scene, motion=(rest, press), contact_nodes=nodes)
    mechanics = mechanics_of(scene, place)
    last = len(mechanics) - 1
    surfaces = steps_to(mechanics, last, scene.sensor, APPROACH)
    reference = scene.sensor.pattern.corners()
    result: dict[str, NDArray[Any]] = {
        "inside": in_contact(mechanics, last, reference)[None],
        "true": (surfaces[-1].corners() - reference)[None],
    }
    return result | _all_prints(scene.sensor, surfaces, draws)


def _scene(*, fast: bool) -> Scene:
    """The packaged scene; the fast run solves two frames on fewer nodes."""
    scene = load_scene("precision_sphere")
    if not fast:
        return scene
    rest, press, _, turn, _ = scene.motion
    motion = tuple(replace(phase, frames=1) for phase in (rest, press, turn))
    return replace(scene, motion=motion, contact_nodes=24)


def _all_prints(
    sensor: SensorDescription, surfaces: Sequence[DeformedSurface], draws: int
) -> dict[str, NDArray[Any]]:
    """KEY_errors and KEY_counts of every method in the last of the surfaces."""
    result: dict[str, NDArray[Any]] = {}
    for pattern_type in PRINTS:
        trials = _Trials(sensor, surfaces, pattern_type, [len(surfaces) - 1])
        result |= trials.all_methods(draws)
    return result


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
