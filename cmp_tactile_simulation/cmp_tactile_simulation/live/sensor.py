"""A simulated sensor in real time: contact on a thread of its own, pictures when asked for."""

from __future__ import annotations

from dataclasses import replace

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_simulation.live import exchange, motion
from cmp_tactile_simulation.live.camera import LiveCamera
from cmp_tactile_simulation.live.contact import LiveContact, LiveState
from cmp_tactile_simulation.rendering.renderer import OpticalTruth
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene


class LiveSensor:
    """A live sensor in this process.

    The elastic model is linear, whatever the sensor's is: another would take longer than there is
    time.  Until the model is built (the first time for a sensor), the frames show the gel at rest.
    """

    def __init__(self, scene: Scene, settings: motion.LiveSettings, rate: float) -> None:
        """rate: contact steps per second that are aimed at, Hz."""
        self._scene = live_scene(scene, settings)
        self._contact = LiveContact(self._scene, settings, rate)
        self._camera = LiveCamera(self._scene)
        self._truth = OpticalTruth(self._scene.sensor)
        self._contact.start()

    def picture(self, wanted: exchange.TruthWanted = exchange.TruthWanted()) -> exchange.LiveFrame:  # noqa: B008  frozen
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        if self._contact.failure:
            msg = f"scene {self._scene.name}: {self._contact.failure}"
            raise FrameSourceError(msg)
        # In this order: the state is as new as the status or newer.
        status, state = self._contact.status, self._contact.latest
        surface = self._surface(state)
        image = self._camera.picture(surface)
        self._contact.pictured(state)
        return exchange.LiveFrame(
            image=image,
            origin=f"{self._scene.name} [{state.number if state else 'at rest'}]",
            status=status,
            pose=state.contact.pose if state else None,
            force=self._contact.force_field(state.contact) if state and wanted.force else None,
            grids=self._truth.grids(surface) if wanted.optics else None,
            surface=self._truth.surface(surface) if wanted.optics else None,
        )

    def command(self, command: exchange.Command) -> None:
        """Ask something of the indenter; CommandError for what cannot be."""
        exchange.check_command(command, self._scene.sensor)
        self._contact.command(command)

    def close(self) -> None:
        """End the mechanics."""
        self._contact.stop()

    def _surface(self, state: LiveState | None) -> DeformedSurface:
        pattern, observers = self._scene.sensor.pattern, self._contact.observers
        if state is None or observers is None:
            return DeformedSurface.rest(pattern)
        return DeformedSurface(pattern, observers, state.moved)


def live_scene(scene: Scene, settings: motion.LiveSettings) -> Scene:
    """The scene with what can be had in real time."""
    sensor = replace(scene.sensor, elastomer=replace(scene.sensor.elastomer, model="linear"))
    return replace(
        scene,
        sensor=sensor,
        contact_nodes=min(scene.contact_nodes, settings.contact_nodes),
        samples=min(scene.samples, settings.samples),
    )
