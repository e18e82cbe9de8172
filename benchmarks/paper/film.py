"""Frames of a gel, as a camera sees any print on it, and what is true of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard, Dots
from cmp_tactile_simulation.rendering.optical_truth import OpticalTruth
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import RenderedFrame, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface

__all__ = ["DOT_DIAMETER", "Film", "Truth"]

# Of a dot, as a share of the pitch: see results/paper_dot_tuning.md.
DOT_DIAMETER = 0.35
SAMPLES = 4


@dataclass(frozen=True)
class Truth:
    """What is true of a frame: grids by view, px of the view; surface, gel frame, m."""

    grids: Mapping[str, Grid]
    surface: Surface


class Film:
    """A camera on a sensor with one print.

    pattern_type: cmp (checkers) or dmp (dots at the places of the corners, `dot_diameter` of the
    pitch wide).  seed: of the noise; frames differ in it by their number.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        pattern_type: str,
        camera: CameraSettings | None = None,
        seed: int = 0,
        dot_diameter: float = DOT_DIAMETER,
    ) -> None:
        self.sensor = sensor
        self._camera = camera or CameraSettings()
        self._seed = seed
        ink = (
            Checkerboard(sensor.pattern)
            if pattern_type == "cmp"
            else Dots(sensor.pattern, diameter=dot_diameter)
        )
        self._renderer = Renderer(sensor, ink, samples=SAMPLES)
        self._truth = OpticalTruth(sensor)

    def image(self, surface: DeformedSurface, number: int) -> NDArray[np.uint8]:
        """The camera's frame (H, W) of a surface; `number` sets its noise."""
        return self.exposed(self.rendered(surface), number)

    def rendered(self, surface: DeformedSurface) -> RenderedFrame:
        """The frame in even light without blur and noise, to be exposed several times."""
        return self._renderer.render(surface)

    def exposed(
        self, rendered: RenderedFrame, number: int, camera: CameraSettings | None = None
    ) -> NDArray[np.uint8]:
        """The camera's frame (H, W) of what was rendered, under other settings where given."""
        rng = random_stream(Purpose.FRAME_NOISE, self._seed, number)
        return expose([rendered], camera or self._camera, rng, self._seed)

    def true_surface(self, surface: DeformedSurface) -> Surface:
        """The markers in 3-D alone, in less time than `truth`."""
        return self._truth.surface(surface)

    def truth(self, surface: DeformedSurface) -> Truth:
        """What is true of the frame of a surface."""
        return Truth(self._truth.grids(surface), self._truth.surface(surface))
