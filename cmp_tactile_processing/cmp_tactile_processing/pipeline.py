"""The whole chain: split -> track -> triangulate -> force.  The only module that joins stages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.displacement import Reference
from cmp_tactile_processing.force import ForceModel
from cmp_tactile_processing.force_field import ForceField
from cmp_tactile_processing.grid import Grid
from cmp_tactile_processing.markers_3d import Markers3D
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.split import check_image, split_frame, to_grey
from cmp_tactile_processing.stereo import StereoRig
from cmp_tactile_processing.surface import Surface
from cmp_tactile_processing.tracker import GridTracker

__all__ = ["Pipeline", "PipelineResult"]


@dataclass(frozen=True)
class PipelineResult:
    """What one frame showed.  A monocular sensor's other grid is None."""

    left: Grid | None
    right: Grid | None
    surface: Surface
    force: ForceField


class Pipeline:
    """Processes frames of one sensor; the force model is built once and cached on disk."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor = sensor
        self._rig = StereoRig(sensor)
        self._trackers = {name: GridTracker(sensor, name) for name in self._rig.views}
        self._force = ForceModel(sensor)
        self._reference = Reference.nominal(sensor)

    def process(self, frame: NDArray[np.uint8]) -> PipelineResult:
        """Everything that a frame, (H, W) grey or (H, W, 3) BGR uint8, shows.

        Raises FrameError for a frame of another size or type.
        """
        grids, markers = self._measure(frame)
        surface = self._reference.surface(markers)
        force = self._force.reconstruct(surface.displacement, surface.status)
        return PipelineResult(grids.get("left"), grids.get("right"), surface, force)

    def set_reference(self, frames: Iterable[NDArray[np.uint8]]) -> None:
        """Measure displacements against the mean of these frames of the gel at rest from now on.

        Raises ReferenceFramesError where they cannot serve, FrameError for a wrong frame; the
        reference then stays as it was.
        """
        markers = [self._measure(frame)[1] for frame in frames]
        self._reference = Reference.average(markers, self._reference.id + 1)

    def reset(self) -> None:
        """Forget the tracking state, as after start-up; keeps the reference."""
        for tracker in self._trackers.values():
            tracker.reset()

    def _measure(self, frame: NDArray[np.uint8]) -> tuple[dict[str, Grid], Markers3D]:
        image = self._sensor.image
        check_image(frame, image.width, image.height, "frame")
        grey = to_grey(frame)
        grids = {
            name: self._trackers[name].track(split_frame(grey, view.placement))
            for name, view in self._rig.views.items()
        }
        return grids, self._rig.triangulate(grids.get("left"), grids.get("right"))
