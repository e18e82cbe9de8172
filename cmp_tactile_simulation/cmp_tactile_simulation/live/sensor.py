"""A simulated sensor in real time: contact on a thread of its own, pictures when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from itertools import count

from cmp_tactile_driver.sources.frames import Frame
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Roi
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.live.mechanics import (
    Command,
    LiveContact,
    LiveSettings,
    LiveState,
    LiveStatus,
    check_command,
)
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.simulator import SensorCamera


@dataclass(frozen=True)
class TruthWanted:
    """What is reported of a frame beside its picture.

    force: the force field.  optics: grids and surface.
    """

    force: bool = False
    optics: bool = False


@dataclass(frozen=True)
class LiveFrame(Frame):
    """A frame, how the sensor is, and what was wanted of its truth.

    pose: of the indenter; None for the gel at rest before there is a state, which has no force
    field either.  grids: by view, px of the view.
    """

    status: LiveStatus
    pose: Pose | None = None
    force: ForceField | None = None
    grids: Mapping[str, Grid] | None = None
    surface: Surface | None = None


class LiveSensor:
    """A live sensor in this process.

    Its frames are those of `Simulator`, with what there is time for: the rays of 2 x 2 pixels are
    found together where the frame can be halved, and the elastic model is linear, whatever the
    sensor's is.  Until the model is built (the first time for a sensor), the frames show the gel
    at rest.
    """

    def __init__(self, scene: Scene, settings: LiveSettings, rate: float) -> None:
        """rate: contact steps per second that are aimed at, Hz."""
        self._scene = live_scene(scene, settings)
        self._contact = LiveContact(self._scene, settings, rate)
        sensor = self._scene.sensor
        self._camera = SensorCamera(sensor, self._scene.look, with_half_the_pixels(sensor))
        self._numbers = count()
        self._contact.start()

    def picture(self, wanted: TruthWanted = TruthWanted()) -> LiveFrame:
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        if self._contact.failure:
            msg = f"scene {self._scene.name}: {self._contact.failure}"
            raise FrameSourceError(msg)
        # In this order: the state is as new as the status or newer.
        status, state = self._contact.status, self._contact.latest
        surface = self._surface(state)
        image = self._camera.picture(next(self._numbers), surface)
        self._contact.pictured(state)
        return LiveFrame(
            image=image,
            origin=f"{self._scene.name} [{state.number if state else 'at rest'}]",
            status=status,
            pose=state.contact.pose if state else None,
            force=self._contact.force_field(state.contact) if state and wanted.force else None,
            grids=self._camera.truth.grids(surface) if wanted.optics else None,
            surface=self._camera.truth.surface(surface) if wanted.optics else None,
        )

    def command(self, command: Command) -> None:
        """Ask something of the indenter; InputError for what cannot be."""
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


def live_scene(scene: Scene, settings: LiveSettings) -> Scene:
    """The scene with what can be had in real time."""
    sensor = replace(scene.sensor, elastomer=replace(scene.sensor.elastomer, model="linear"))
    return replace(
        scene,
        sensor=sensor,
        contact_nodes=min(scene.contact_nodes, settings.contact_nodes),
        samples=min(scene.samples, settings.samples),
    )


def with_half_the_pixels(sensor: SensorDescription) -> SensorDescription | None:
    """The same sensor with pixels of twice the size; None where a side of a view is odd."""
    image = sensor.image
    rois = {name: astuple(view.roi) for name, view in sensor.views.items()}
    if any(side % 2 for roi in (*rois.values(), (image.width, image.height)) for side in roi):
        return None
    views = {
        name: replace(
            view,
            roi=Roi(*(side // 2 for side in rois[name])),
            camera=_with_half_the_pixels(view.camera),
        )
        for name, view in sensor.views.items()
    }
    return replace(
        sensor,
        image=replace(image, width=image.width // 2, height=image.height // 2),
        camera=_with_half_the_pixels(sensor.camera),
        views=views,
    )


def _with_half_the_pixels(camera: Camera | None) -> Camera | None:
    if camera is None:
        return None
    # The centre of the top-left pixel is (0, 0).
    return replace(
        camera,
        fx=camera.fx / 2,
        fy=camera.fy / 2,
        cx=(camera.cx + 0.5) / 2 - 0.5,
        cy=(camera.cy + 0.5) / 2 - 0.5,
    )
