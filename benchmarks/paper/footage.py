"""Frames of a contact in one print, rendered once and exposed with many draws of noise.

A draw is a number; frames of the same draw have independent noise, and the same draw gives the
same noise in either print.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import Chain, Measurement
from paper.film import DOT_DIAMETER, Film, Truth
from paper.mechanics import Mechanics
from paper.scoring import displacement_error, position_error

__all__ = [
    "REST_FRAMES",
    "Exposure",
    "Footage",
    "error_stack",
    "measured",
    "steps_to",
    "with_steps_between",
]

# What displacements are measured against: the mean of so many frames of the gel at rest.
REST_FRAMES = 4
# Numbers of frames that one draw may use, so that no two draws share noise.
FRAMES_OF_A_DRAW = 1000


@dataclass(frozen=True)
class Exposure:
    """Frames (H, W) of the gel at rest and then in contact."""

    rest: list[NDArray[np.uint8]]
    frames: list[NDArray[np.uint8]]


class Footage:
    """The gel at rest and then these surfaces, as a camera sees them in a print (cmp or dmp)."""

    def __init__(
        self,
        sensor: SensorDescription,
        surfaces: Sequence[DeformedSurface],
        pattern_type: str,
        dot_diameter: float = DOT_DIAMETER,
    ) -> None:
        self._film = Film(sensor, pattern_type, dot_diameter=dot_diameter)
        self._surfaces = surfaces
        self._rest = self._film.rendered(DeformedSurface.rest(sensor.pattern))
        self._rendered = [self._film.rendered(surface) for surface in surfaces]

    def __len__(self) -> int:
        return len(self._surfaces)

    def truth(self, index: int) -> Truth:
        """What is true of a frame."""
        return self._film.truth(self._surfaces[index])

    def true_surface(self, index: int) -> Surface:
        """The markers in 3-D in a frame."""
        return self._film.true_surface(self._surfaces[index])

    def exposed(self, draw: int, camera: CameraSettings | None = None) -> Exposure:
        """All frames with one draw of noise."""
        first = draw * FRAMES_OF_A_DRAW
        frames = [self._rest] * REST_FRAMES + self._rendered
        images = [self._film.exposed(frame, first + k, camera) for k, frame in enumerate(frames)]
        return Exposure(images[:REST_FRAMES], images[REST_FRAMES:])


def measured(chain: Chain, exposure: Exposure) -> Iterator[Measurement]:
    """What a chain measures in each frame, beginning anew at rest.

    Raises ReferenceFramesError where it makes no reference of the frames at rest.
    """
    chain.reset()
    chain.set_reference(exposure.rest)
    for image in exposure.frames:
        yield chain.measure(image)


def with_steps_between(
    mechanics: Mechanics, frames: Sequence[int], sensor: SensorDescription, steps: int
) -> list[DeformedSurface]:
    """Surfaces of these frames, each reached in `steps` equal steps from the one before.

    The first is reached from rest.  A tracker from frame to frame then sees small movements also
    where few frames were solved; frame k of `frames` is surface (k + 1) * steps - 1.
    """
    before = np.zeros_like(mechanics.displacement[0])
    surfaces = []
    for frame in frames:
        after = mechanics.displacement[frame]
        for step in range(1, steps + 1):
            moved = before + (after - before) * (step / steps)
            surfaces.append(DeformedSurface(sensor.pattern, mechanics.observers, moved))
        before = after
    return surfaces


def steps_to(
    mechanics: Mechanics, frame: int, sensor: SensorDescription, steps: int
) -> list[DeformedSurface]:
    """Surfaces on a straight way from rest to a frame."""
    return with_steps_between(mechanics, [frame], sensor, steps)


def error_stack(surface: Surface, truth: Surface) -> NDArray[np.float32]:
    """Errors of displacement and of position (2, rows, cols, 3), m; NaN where missing."""
    pair = displacement_error(surface, truth), position_error(surface, truth)
    return np.stack(pair).astype(np.float32)
