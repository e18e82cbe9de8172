"""A simulated sensor in place of a camera: frames in real time, the indenter moved by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import Frame, NodeExtension, SourceHealth, SourceOptions
from cmp_tactile_processing.force_field import ForceField
from cmp_tactile_processing.grid import Grid
from cmp_tactile_processing.surface import Surface
from cmp_tactile_simulation.contact_state import Load
from cmp_tactile_simulation.deformed_surface import DeformedSurface
from cmp_tactile_simulation.errors import CommandError
from cmp_tactile_simulation.live_camera import LiveCamera
from cmp_tactile_simulation.live_contact import LiveContact, LiveMode, LiveState
from cmp_tactile_simulation.live_motion import LiveSettings
from cmp_tactile_simulation.optical_truth import true_grids, true_surface
from cmp_tactile_simulation.pose import Pose
from cmp_tactile_simulation.scene import Scene
from cmp_tactile_simulation.scene_library import load_scene

__all__ = ["LiveFrame", "LiveSensor", "live_scene"]

FRAME_RATE = 20.0
"""Unless the driver asks for another, Hz: what two cores keep up with beside the whole graph."""
HIGHEST_M = 0.1
UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class LiveFrame(Frame):
    """A frame, and the state that it shows; None for the gel at rest before there is a state."""

    state: LiveState | None


class LiveSensor:
    """A FrameSource that renders a scene while its contact is solved on another thread.

    The elastic model is linear, whatever the sensor's is, and motion blur is left out: both would
    take longer than there is time.  Until the model is built (the first time for a sensor), the
    frames show the gel at rest.
    """

    def __init__(
        self, scene: Scene, frame_rate: float = 0.0, settings: LiveSettings | None = None
    ) -> None:
        """frame_rate: Hz, 0 for FRAME_RATE or the scene's own if that is lower."""
        self._scene = scene
        self._frame_rate = frame_rate or min(FRAME_RATE, scene.rate)
        self._settings = settings or LiveSettings()
        self._contact: LiveContact | None = None
        self._camera: LiveCamera | None = None

    @classmethod
    def from_options(cls, options: SourceOptions) -> LiveSensor:
        """The source `simulated` of the driver: its input is the scene's name or file.

        The sensor of the options takes the place of the scene's.  SceneError for a wrong scene.
        """
        scene = load_scene(options.input)
        return cls(replace(scene, sensor=options.sensor), options.frame_rate)

    @property
    def name(self) -> str:
        """The scene."""
        return f"scene {self._scene.name}"

    @property
    def scene(self) -> Scene:
        """What is simulated."""
        return self._scene

    @property
    def frame_rate(self) -> float:
        """Frames per second that are aimed at."""
        return self._frame_rate

    @property
    def health(self) -> SourceHealth:
        """Why the contact stays as it is, where it cannot be solved."""
        return SourceHealth(problem=self._contact.problem if self._contact else "")

    @property
    def settings(self) -> LiveSettings:
        """How it is simulated; may be set until the first frame is read."""
        return self._settings

    @settings.setter
    def settings(self, settings: LiveSettings) -> None:
        self._settings = settings

    @property
    def mode(self) -> LiveMode:
        """What the indenter does."""
        return LiveMode.BUILDING if self._contact is None else self._contact.mode

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """What it does and what that costs, by name."""
        contact = self._contact
        if contact is None:
            return {}
        return {
            "indenter": contact.mode.value,
            "elastic model": contact.note or "from the cache",
            "contact step (ms)": f"{contact.step_s * 1e3:.1f}",
            "samples of a pixel": self._settings.samples**2,
        }

    def read(self) -> LiveFrame:
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        contact = self._started()
        if contact.failure:
            msg = f"{self.name}: {contact.failure}"
            raise FrameSourceError(msg)
        state = contact.latest
        if self._camera is None:
            self._camera = LiveCamera(live_scene(self._scene, self._settings))
        image = self._camera.picture(self.surface(state))
        number = "at rest" if state is None else str(state.number)
        return LiveFrame(image, f"{self._scene.name} [{number}]", state)

    def close(self) -> None:
        """End the mechanics."""
        if self._contact is not None:
            self._contact.stop()
            self._contact = None

    def extend(self, node: Any) -> NodeExtension:
        """Topics and services to move the indenter and to publish what is true."""
        from cmp_tactile_simulation.nodes.live_source import LiveSource

        return LiveSource(node, self)

    def move_to(self, target: Pose) -> None:
        """Let the indenter go there; CommandError for what is no pose or out of reach."""
        _check_rotation(target)
        x, y, thickness = self._scene.sensor.elastomer.size
        limits = ((-x / 2, x / 2), (-y / 2, y / 2), (-thickness, HIGHEST_M))
        for name, value, (low, high) in zip("xyz", target.position.tolist(), limits, strict=True):
            if not low <= value <= high:
                msg = f"position.{name}: found {value:g} m, expected {low:g} to {high:g} m"
                raise CommandError(msg)
        self._started().aim(target)

    def press(self, load: Load) -> None:
        """Let the indenter press with that load; CommandError for what is no such load."""
        values = (load.normal, *load.tangential, load.torque)
        if not all(map(math.isfinite, values)):
            msg = f"found force and torque {values}, expected finite numbers"
            raise CommandError(msg)
        if load.normal <= 0:
            msg = f"force.z: found {-load.normal:g} N, expected less than 0: into the gel"
            raise CommandError(msg)
        self._started().aim(load)

    def reset(self) -> None:
        """Back to the beginning of the scene, the gel at rest."""
        self._started().reset()

    def surface(self, state: LiveState | None) -> DeformedSurface:
        """The marker surface in a state; at rest where there is none."""
        pattern = self._scene.sensor.pattern
        observers = self._contact.observers if self._contact else None
        if state is None or observers is None:
            return DeformedSurface.rest(pattern)
        return DeformedSurface(pattern, observers, state.moved)

    def force_field(self, state: LiveState) -> ForceField:
        """The true force field in a state."""
        return self._started().force_field(state.contact)

    def truth(self, state: LiveState | None) -> tuple[Mapping[str, Grid], Surface]:
        """Grids by view, px of the view, and the surface, as they truly are in a state."""
        surface, sensor = self.surface(state), self._scene.sensor
        return true_grids(sensor, surface), true_surface(sensor, surface)

    def _started(self) -> LiveContact:
        if self._contact is None:
            scene = live_scene(self._scene, self._settings)
            self._contact = LiveContact(scene, self._settings, self._frame_rate)
            self._contact.start()
        return self._contact


def live_scene(scene: Scene, settings: LiveSettings) -> Scene:
    """The scene with what can be had in real time."""
    sensor = replace(scene.sensor, elastomer=replace(scene.sensor.elastomer, model="linear"))
    return replace(
        scene,
        sensor=sensor,
        contact_nodes=min(scene.contact_nodes, settings.contact_nodes),
        samples=min(scene.samples, settings.samples),
        camera=replace(scene.camera, motion_samples=1),
    )


def _check_rotation(pose: Pose) -> None:
    if not (np.isfinite(pose.position).all() and np.isfinite(pose.rotation).all()):
        msg = "found a number that is not finite, expected a pose"
        raise CommandError(msg)
    error = np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max()
    if error > UNIT_TOLERANCE or np.linalg.det(pose.rotation) < 0:
        msg = "found no rotation, expected a proper one"
        raise CommandError(msg)
