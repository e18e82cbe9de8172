"""A simulated sensor in real time: contact on a thread of its own, pictures when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_processing.measured.force_field import ForceField
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_simulation.live.camera import LiveCamera
from cmp_tactile_simulation.live.commands import Command, check_command
from cmp_tactile_simulation.live.contact import LiveContact, LiveState
from cmp_tactile_simulation.live.frame import LiveFrame, TruthWanted
from cmp_tactile_simulation.live.motion import LiveSettings
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from cmp_tactile_simulation.rendering.optical_truth import OpticalTruth
from cmp_tactile_simulation.scenes.description import Scene

__all__ = ["Live", "LiveSensor", "live_scene"]


class Live(Protocol):
    """A live sensor, wherever it runs."""

    def picture(self, wanted: TruthWanted) -> LiveFrame:
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""

    def command(self, command: Command) -> None:
        """Ask something of the indenter; CommandError for what cannot be."""

    def close(self) -> None:
        """End it."""


class LiveSensor:
    """A `Live` in this process.

    The elastic model is linear, whatever the sensor's is, and motion blur is left out: both would
    take longer than there is time.  Until the model is built (the first time for a sensor), the
    frames show the gel at rest.
    """

    def __init__(self, scene: Scene, settings: LiveSettings, rate: float) -> None:
        """rate: contact steps per second that are aimed at, Hz."""
        self._scene = live_scene(scene, settings)
        self._contact = LiveContact(self._scene, settings, rate)
        self._camera = LiveCamera(self._scene)
        self._truth = OpticalTruth(self._scene.sensor)
        self._contact.start()

    def picture(self, wanted: TruthWanted = TruthWanted()) -> LiveFrame:  # noqa: B008  frozen
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        if self._contact.failure:
            msg = f"scene {self._scene.name}: {self._contact.failure}"
            raise FrameSourceError(msg)
        # In this order: the state is as new as the status or newer.
        status, state = self._contact.status, self._contact.latest
        surface = self._surface(state)
        grids, markers = self._optics(surface) if wanted.optics else (None, None)
        return LiveFrame(
            image=self._camera.picture(surface),
            origin=f"{self._scene.name} [{state.number if state else 'at rest'}]",
            status=status,
            pose=state.contact.pose if state else None,
            force=self._force(state) if state and wanted.force else None,
            grids=grids,
            surface=markers,
        )

    def command(self, command: Command) -> None:
        """Ask something of the indenter; CommandError for what cannot be."""
        check_command(command, self._scene.sensor)
        self._contact.command(command)

    def close(self) -> None:
        """End the mechanics."""
        self._contact.stop()

    def _surface(self, state: LiveState | None) -> DeformedSurface:
        pattern, observers = self._scene.sensor.pattern, self._contact.observers
        if state is None or observers is None:
            return DeformedSurface.rest(pattern)
        return DeformedSurface(pattern, observers, state.moved)

    def _force(self, state: LiveState) -> ForceField:
        return self._contact.force_field(state.contact)

    def _optics(self, surface: DeformedSurface) -> tuple[Mapping[str, Grid], Surface]:
        return self._truth.grids(surface), self._truth.surface(surface)


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
