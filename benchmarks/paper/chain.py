"""A method's whole chain: split, track, triangulate, force; all but the tracker is the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured.force_field import ForceField
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from paper.method import Method

__all__ = ["Chain", "Measurement"]


@dataclass(frozen=True)
class Measurement:
    """What a method measured in a frame; grids by view.  force: None where it is not asked for."""

    grids: Mapping[str, Grid]
    surface: Surface
    force: ForceField | None


class Chain:
    """A method on a sensor.  Raises what the stages raise."""

    def __init__(
        self, sensor: SensorDescription, method: Method, *, with_force: bool = False
    ) -> None:
        sensor = method.settings(sensor)
        self._rig = StereoRig(sensor)
        self._trackers = {name: method.tracker(sensor, name) for name in self._rig.views}
        self._reference = Reference.nominal(sensor)
        self._force = ForceStage(sensor) if with_force else None

    def set_reference(self, images: Sequence[NDArray[np.uint8]]) -> None:
        """Measure displacements against the mean of these frames (H, W) of the gel at rest."""
        for name, tracker in self._trackers.items():
            tracker.learn([self._view(image, name) for image in images])
        markers = []
        for image in images:
            grids = self._track(image)
            markers.append(self._rig.triangulate(grids["left"], grids["right"]))
        self._reference = Reference.average(markers, reference_id=1)

    def measure(self, image: NDArray[np.uint8]) -> Measurement:
        """Everything that the next frame (H, W) shows."""
        grids = self._track(image)
        surface = self._reference.surface(self._rig.triangulate(grids["left"], grids["right"]))
        force = self._force.process(surface) if self._force else None
        return Measurement(grids, surface, force)

    def reset(self) -> None:
        """Forget earlier frames, but not the reference."""
        for tracker in self._trackers.values():
            tracker.reset()
        if self._force:
            self._force.reset()

    def _track(self, image: NDArray[np.uint8]) -> dict[str, Grid]:
        return {name: t.track(self._view(image, name)) for name, t in self._trackers.items()}

    def _view(self, image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
        placement = self._rig.views[name].placement
        room = np.empty((placement.height, placement.width), np.uint8)
        return split_frame(image, placement, room)
