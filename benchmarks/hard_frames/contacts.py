"""Bodies that are pressed, dragged and twisted on a gel: frames, and the true force and slip."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.measured import SlipEstimate, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Load, Pose
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenters import Indenter
from cmp_tactile_simulation.scenes.description import Phase, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import slip_estimate

Array = NDArray[np.float64]


def frames_of_ball(
    sensor: SensorDescription, start: Touch, *motion: Phase, **changes: Any
) -> tuple[list[NDArray[np.uint8]], Array]:
    """Frames of the packaged ball that moves so, and its forces (n, 3) N; changes: of the scene."""
    scene = replace(load_scene("contact_sphere"), sensor=sensor, **changes)
    frames = Simulation(replace(scene, start=Start(start), motion=motion)).frames()
    images, forces = zip(*((f.image, f.force.wrench[:3]) for f in frames), strict=True)
    return list(images), np.stack(forces)


def at_markers(observers: SurfaceGrid, markers: SurfaceGrid, moved: Array) -> Array:
    """A smooth displacement (rows, cols, 3) of the observers at the markers, by splines."""
    parts = [
        RectBivariateSpline(observers.y, observers.x, moved[..., axis])(markers.y, markers.x)
        for axis in range(3)
    ]
    return np.stack(parts, axis=-1)


@dataclass(frozen=True)
class Frame:
    """Displacement of the gel's observers (rows, cols, 3), m, and what is true of the slip."""

    phase: str
    moved: Array
    truth: SlipEstimate


class Trial:
    """A body on the gel; every step is a frame."""

    def __init__(
        self, gel: LinearElastomer, body: Indenter, friction: float, at: tuple[float, float]
    ) -> None:
        self._gel, self.friction = gel, friction
        self._contact = ContactSimulation(gel, body, friction)
        self._state = self._contact.rest(self._contact.touch(Pose(np.array([*at, 0.0]))))
        self.frames: list[Frame] = []
        self._record("rest")

    def press(
        self, normal: float, frames: int, along: tuple[float, float] = (0, 0), phase: str = ""
    ) -> Trial:
        """Go to a load."""
        begin = self._contact.driven_load(self._state)
        for share in np.arange(1, frames + 1) / frames:
            x, y = (b + share * (e - b) for b, e in zip(begin.tangential, along, strict=True))
            load = Load(begin.normal + share * (normal - begin.normal), (x, y))
            self._state = self._contact.press(self._state, load)
            self._record(phase)
        return self

    def move(
        self,
        by: tuple[float, float, float],
        frames: int,
        turn: tuple[float, ...] = (0, 0, 0),
        phase: str = "",
    ) -> Trial:
        """Go by a way, m, and a turn, rad."""
        begin = self._state.pose
        turned = Rotation.from_rotvec(turn).as_matrix() @ begin.rotation
        end = Pose(begin.position + np.array(by), turned)
        for share in np.arange(1, frames + 1) / frames:
            self._state = self._contact.move(self._state, begin.towards(end, share))
            self._record(phase)
        return self

    def hold(self, frames: int, phase: str = "") -> Trial:
        """Stay."""
        for _ in range(frames):
            self._record(phase)
        return self

    def _record(self, phase: str) -> None:
        truth = slip_estimate(self._contact, self._state)
        self.frames.append(Frame(phase, self._gel.marker_displacement(self._state.force), truth))
