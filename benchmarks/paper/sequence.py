"""Frames of a gel with any print, as a camera sees it, and their truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard, Dots
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, RenderedFrame, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.chain import Chain, Measurement
from paper.lab import Mechanics

Image = NDArray[np.uint8]

# Of a dot, as a share of the pitch: see results/paper_dot_tuning.md.
DOT_DIAMETER = 0.35
SAMPLES = 4


@dataclass(frozen=True)
class Truth:
    """What is true of a frame: grids by view, px of the view; surface, gel frame, m."""

    grids: Mapping[str, Grid]
    surface: Surface


class PrintedGel:
    """A camera on a sensor with one print.

    pattern_type: cmp (checkers) or dmp (dots at the places of the corners, `dot_diameter` of the
    pitch wide).  Frames differ in noise by their number.
    """

    def __init__(
        self, sensor: SensorDescription, pattern_type: str, dot_diameter: float = DOT_DIAMETER
    ) -> None:
        self.sensor = sensor
        ink = (
            Checkerboard(sensor.pattern)
            if pattern_type == "cmp"
            else Dots(sensor.pattern, diameter=dot_diameter)
        )
        self._renderer = Renderer(sensor, ink, samples=SAMPLES)
        self._truth = OpticalTruth(sensor)

    def image(self, surface: DeformedSurface, number: int) -> Image:
        """The camera's frame (H, W) of a surface; `number` sets its noise."""
        return self.exposed(self.rendered(surface), number)

    def rendered(self, surface: DeformedSurface) -> RenderedFrame:
        """The frame in even light without blur and noise, to be exposed several times."""
        return self._renderer.render(surface)

    def exposed(
        self, rendered: RenderedFrame, number: int, camera: CameraSettings | None = None
    ) -> Image:
        """The camera's frame (H, W) of what was rendered, under other settings where given."""
        rng = random_stream(Purpose.FRAME_NOISE, 0, number)
        return expose(rendered, camera or CameraSettings(), rng, 0)

    def truth(self, surface: DeformedSurface) -> Truth:
        """What is true of the frame of a surface."""
        return Truth(self._truth.grids(surface), self._truth.surface(surface))


# What displacements are measured against: the mean of so many frames of the gel at rest.
REST_FRAMES = 4
# Numbers of frames that one draw may use, so that no two draws share noise.
FRAMES_OF_A_DRAW = 1000


@dataclass(frozen=True)
class Exposure:
    """Frames (H, W) of the gel at rest and then in contact."""

    rest: list[Image]
    frames: list[Image]


class RenderedSequence:
    """The gel at rest and then these surfaces, as a camera sees them in a print (cmp or dmp)."""

    def __init__(
        self,
        sensor: SensorDescription,
        surfaces: Sequence[DeformedSurface],
        pattern_type: str,
        dot_diameter: float = DOT_DIAMETER,
    ) -> None:
        self._gel = PrintedGel(sensor, pattern_type, dot_diameter=dot_diameter)
        self._surfaces = surfaces
        self._rest = self._gel.rendered(DeformedSurface.rest(sensor.pattern))
        self._rendered = [self._gel.rendered(surface) for surface in surfaces]

    def __len__(self) -> int:
        return len(self._surfaces)

    def truth(self, index: int) -> Truth:
        """What is true of a frame."""
        return self._gel.truth(self._surfaces[index])

    def exposed(self, draw: int) -> Exposure:
        """All frames with one draw of noise."""
        first = draw * FRAMES_OF_A_DRAW
        frames = [self._rest] * REST_FRAMES + self._rendered
        images = [self._gel.exposed(frame, first + k) for k, frame in enumerate(frames)]
        return Exposure(images[:REST_FRAMES], images[REST_FRAMES:])


def measured(chain: Chain, exposure: Exposure) -> Iterator[Measurement]:
    """What a chain measures in each frame, beginning again at rest.

    Raises CalibrationError where it makes no reference of the frames at rest.
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
