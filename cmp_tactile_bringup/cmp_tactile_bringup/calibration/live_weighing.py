"""Weights put on a running sensor one after another, by somebody who is asked to."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.gel_recording import GelMotion, MarkerCamera, displaced
from cmp_tactile_bringup.calibration.known_loads import weight_on_gel
from cmp_tactile_bringup.calibration.load_samples import averaged
from cmp_tactile_bringup.calibration.steady_frames import largest_motion, motion_limit
from cmp_tactile_processing.calibration.material.sample import LoadSample
from cmp_tactile_processing.measured.markers_3d import Markers3D
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["Weighing"]

# Frames that were taken before the weight was on may still be waiting.
STALE_FRAMES = 4

Ask = Callable[[str], object]
Tell = Callable[[str], None]


@dataclass
class Weighing:
    """Takes frames of a gel at rest and under each weight.

    frames: of the camera, as they come; count: taken of each load; ask: puts a text to whoever
    holds the weights and waits; tell: what came of it.
    """

    sensor: SensorDescription
    frames: Iterator[NDArray[np.uint8]]
    count: int
    ask: Ask
    tell: Tell
    _markers: list[Markers3D] = field(default_factory=list)

    def samples(self, masses: Sequence[float]) -> list[LoadSample]:
        """A sample for each mass in kg; errors as `displaced`, and those of the frames."""
        camera = MarkerCamera(self.sensor)
        self._take(camera, "Let nothing touch the gel")
        for mass in masses:
            self._take(camera, f"Put {mass:g} kg on the gel and let go of it")
        motion = self._motion()
        return [
            self._sample(motion, mass, range(number * self.count, (number + 1) * self.count))
            for number, mass in enumerate(masses, 1)
        ]

    def _take(self, camera: MarkerCamera, wish: str) -> None:
        """Ask until the gel is still."""
        while True:
            self.ask(f"{wish}, then press Enter. ")
            fresh = islice(self.frames, STALE_FRAMES, STALE_FRAMES + self.count)
            taken = [camera.markers(image) for image in fresh]
            position = np.stack([item.position for item in taken])
            moved = max(largest_motion(position[0], item) for item in position[1:])
            limit = motion_limit(position)
            if moved <= limit:
                self._markers += taken
                return
            self.tell(
                f"The gel moves by {moved * 1e6:.0f} um, expected at most {limit * 1e6:.0f} um: "
                "wait until it is still, and once more."
            )

    def _motion(self) -> GelMotion:
        # Frames of a topic are told apart by their order alone.
        stamps = np.arange(len(self._markers), dtype=np.int64)
        return displaced("live", self.sensor, (stamps, self._markers), range(self.count))

    def _sample(self, motion: GelMotion, mass: float, frames: range) -> LoadSample:
        force, std = weight_on_gel(mass)
        return LoadSample(*averaged(motion, frames), force, std, name=f"{mass:g} kg")
