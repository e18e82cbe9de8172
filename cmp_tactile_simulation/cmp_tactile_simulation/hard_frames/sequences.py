"""Sequences of frames of patterns deformed by hand: what a tracker that follows must survive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.hard_frames.case import PatternCase
from cmp_tactile_simulation.hard_frames.cover import Cover
from cmp_tactile_simulation.hard_frames.deformation import Deformation, Zone
from cmp_tactile_simulation.rendering.camera_settings import CameraSettings

__all__ = ["SEQUENCES", "jump", "sequence_of"]

Cases = list[PatternCase]

# Zones of a gel whose pattern is 14.5 mm wide, m: pressed, dragged, and dragged nearly as a whole.
PRESSED, DRAGGED, SHIFTED = 4.5e-3, 8e-3, 9e-3
DEPTH = 1e-3
KNOCK = 1.5e-3
FARTHEST_SHIFT = 2


def jump(
    sensor: SensorDescription, shift: tuple[float, float], depth: float = DEPTH
) -> Deformation:
    """A pressed gel that is shifted nearly as a whole.  shift: along x and y, in checkers."""
    pitch = sensor.pattern.pitch
    moved = Zone(radius=SHIFTED, shift=(shift[0] * pitch, shift[1] * pitch), power=4)
    return Zone(radius=PRESSED, depth=depth, spread=0.05), moved


def _numbered(sensor: SensorDescription, name: str, steps: list[Deformation], seed: int) -> Cases:
    return [
        PatternCase(f"{name} {frame}", sensor, zones, seed=seed, frame=frame)
        for frame, zones in enumerate(steps)
    ]


def _grasp(sensor: SensorDescription, seed: int) -> Cases:
    """At rest, pressed, dragged, knocked, held, knocked back, released step by step, at rest."""
    way = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(way), np.sin(way)])
    steps: list[Deformation] = [(), ()]
    steps += [(_pressed(share),) for share in np.linspace(0.1, 1, 10)]
    drags = [(share * 7e-4, 0.0) for share in np.linspace(0.1, 1, 8)]
    drags += 4 * [(7e-4, KNOCK)] + 2 * [(7e-4, 0.0)]
    for drag, knock in drags:
        moved = Zone(radius=DRAGGED, shift=tuple(drag * ahead))
        knocked = Zone(radius=SHIFTED, shift=tuple(-knock * ahead), power=4)
        steps.append((_pressed(1.0), moved, knocked))
    steps += [(_pressed(share),) for share in (0.6, 0.2)]
    return _numbered(sensor, "grasp", [*steps, ()], seed)


def _pressed(share: float) -> Zone:
    return Zone(radius=PRESSED, depth=share * DEPTH, spread=0.08 * share)


def _released(sensor: SensorDescription, seed: int) -> Cases:
    """A knocked and pressed gel that is at rest one frame later, thrice."""
    rng = np.random.default_rng(seed)
    steps: list[Deformation] = [()]
    for _ in range(3):
        way, length = rng.uniform(0, 2 * np.pi), rng.uniform(1.2, 2.4)
        held = jump(sensor, (length * np.cos(way), length * np.sin(way)))
        steps += [held, held, (), ()]
    return _numbered(sensor, "released", steps, seed)


def _shifted(sensor: SensorDescription, seed: int) -> Cases:
    """Shifts by whole checkers in all directions, each from rest: the lattice looks the same."""
    reach = range(-FARTHEST_SHIFT, FARTHEST_SHIFT + 1)
    steps: list[Deformation] = []
    for right in reach:
        for up in reach:
            steps += [(), jump(sensor, (float(right), float(up)))]
    return _numbered(sensor, "shifted", steps, seed)


def _hidden_for_a_while(sensor: SensorDescription, seed: int) -> Cases:
    """A cover that comes from the left and goes back, over a gel that moves meanwhile."""
    shares = [0.0, 0.15, 0.3, 0.45, 0.6, 0.45, 0.3, 0.15, 0.0]
    steps = [jump(sensor, (0.15 * number, 0.0)) for number in range(len(shares))]
    return [
        replace(case, cover=Cover("left", share, 60.0) if share else None)
        for case, share in zip(_numbered(sensor, "hidden", steps, seed), shares, strict=True)
    ]


def _light_switched(sensor: SensorDescription, seed: int) -> Cases:
    """Light that goes off, comes back brighter, and dims, while the gel is knocked in the dark."""
    lights = [1.0, 1.0, 0.005, 0.005, 1.2, 1.2, 0.4, 0.4, 1.0]
    shifts = [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 2.0, 0.0, 0.0]
    steps = [jump(sensor, (shift, 0.0)) for shift in shifts]
    return [
        replace(case, camera=CameraSettings(light_level=205 * light, dark_level=45 * light))
        for case, light in zip(_numbered(sensor, "light", steps, seed), lights, strict=True)
    ]


SEQUENCES: dict[str, Callable[[SensorDescription, int], Cases]] = {
    "grasp": _grasp,
    "released": _released,
    "shifted": _shifted,
    "hidden for a while": _hidden_for_a_while,
    "light switched": _light_switched,
}


def sequence_of(kind: str, sensor: SensorDescription, seed: int = 0) -> Cases:
    """The frames of that sequence, in order; lengths suit a pattern of about 14.5 mm.

    Raises ParameterError for a kind that is not in SEQUENCES.
    """
    if kind not in SEQUENCES:
        msg = f"sequence: found {kind!r}, expected one of {', '.join(SEQUENCES)}"
        raise ParameterError(msg)
    return SEQUENCES[kind](sensor, seed)
