"""A simulated sensor in real time: contact on a thread of its own, pictures when asked for."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.capture import Worker
from cmp_tactile_driver.sources.timing import Pacer
from cmp_tactile_processing.measured import ForceField, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera
from cmp_tactile_processing.surface.stillness import RestParameters
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.live import motion
from cmp_tactile_simulation.rendering.camera import expose
from cmp_tactile_simulation.rendering.ink import ink_of
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, RenderedFrame, Renderer
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.simulation import Simulation, force_field


class Live(Protocol):
    """A live sensor, wherever it runs."""

    def picture(self, wanted: motion.TruthWanted) -> motion.LiveFrame:
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""

    def command(self, command: motion.Command) -> None:
        """Ask something of the indenter; CommandError for what cannot be."""

    def close(self) -> None:
        """End it."""


class LiveSensor:
    """A `Live` in this process.

    The elastic model is linear, whatever the sensor's is, and motion blur is left out: both would
    take longer than there is time.  Until the model is built (the first time for a sensor), the
    frames show the gel at rest.
    """

    def __init__(self, scene: Scene, settings: motion.LiveSettings, rate: float) -> None:
        """rate: contact steps per second that are aimed at, Hz."""
        self._scene = live_scene(scene, settings)
        self._contact = LiveContact(self._scene, settings, rate)
        self._camera = LiveCamera(self._scene)
        self._truth = OpticalTruth(self._scene.sensor)
        self._contact.start()

    def picture(self, wanted: motion.TruthWanted = motion.TruthWanted()) -> motion.LiveFrame:  # noqa: B008  frozen
        """A frame of the newest state; FrameSourceError where nothing can be simulated."""
        if self._contact.failure:
            msg = f"scene {self._scene.name}: {self._contact.failure}"
            raise FrameSourceError(msg)
        # In this order: the state is as new as the status or newer.
        status, state = self._contact.status, self._contact.latest
        surface = self._surface(state)
        image = self._camera.picture(surface)
        self._contact.pictured(state)
        return motion.LiveFrame(
            image=image,
            origin=f"{self._scene.name} [{state.number if state else 'at rest'}]",
            status=status,
            pose=state.contact.pose if state else None,
            force=self._contact.force_field(state.contact) if state and wanted.force else None,
            grids=self._truth.grids(surface) if wanted.optics else None,
            surface=self._truth.surface(surface) if wanted.optics else None,
        )

    def command(self, command: motion.Command) -> None:
        """Ask something of the indenter; CommandError for what cannot be."""
        motion.check_command(command, self._scene.sensor)
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
        camera=replace(scene.camera, motion_samples=1),
    )


# The camera of a live sensor: frames of a deformed gel in a fraction of the offline time.

# Noise that does not depend on the light is drawn from so many images, at places by chance.
NOISE_IMAGES = 8


class LiveCamera:
    """Takes pictures of a scene's sensor.

    The rays of 2 x 2 pixels are found together where the frame can be halved, and the noise of a
    frame is one of a few images, moved about: both cost most of the time offline.
    """

    def __init__(self, scene: Scene) -> None:
        """scene: as it is to be rendered live."""
        self._scene = scene
        ink = ink_of(scene.sensor.pattern, scene.pattern_type, scene.defects, scene.seed)
        half = with_half_the_pixels(scene.sensor)
        self._is_half = half is not None
        samples = scene.samples * (2 if half else 1)
        self._renderer = Renderer(half or scene.sensor, ink, samples=samples)
        self._rng = np.random.default_rng(scene.seed)
        self._noise = self._noise_images()

    def picture(self, surface: DeformedSurface) -> NDArray[np.uint8]:
        """The frame (height, width) of the gel."""
        rendered = self._renderer.render(surface)
        if self._is_half:
            # Rendered finer than its pixels by 2, it has the full frame's.
            rendered = RenderedFrame(rendered.grey, fineness=1)
        camera = self._scene.camera
        if self._noise is not None:
            camera = replace(camera, read_noise=0.0)
        image = expose([rendered], camera, self._rng, self._scene.seed)
        return image if self._noise is None else self._with_noise(image, self._noise)

    def _noise_images(self) -> NDArray[np.int16] | None:
        """Images of the read noise, grey levels; None where the noise depends on the light."""
        camera, size = self._scene.camera, self._scene.sensor.image
        if camera.full_well > 0 or camera.read_noise == 0:
            return None
        shape = NOISE_IMAGES, size.height, size.width
        noise = self._rng.standard_normal(shape, dtype=np.float32) * camera.read_noise
        return np.asarray(np.rint(noise), np.int16)

    def _with_noise(self, image: NDArray[np.uint8], noise: NDArray[np.int16]) -> NDArray[np.uint8]:
        chosen = noise[self._rng.integers(len(noise))]
        down, right = self._rng.integers(image.shape)
        moved = np.roll(chosen, (down, right), axis=(0, 1))
        return np.asarray(cv2.add(image, moved, dtype=cv2.CV_8U), np.uint8)


def with_half_the_pixels(sensor: SensorDescription) -> SensorDescription | None:
    """The same sensor with pixels of twice the size; None where a side of a view is odd."""
    image, views = sensor.image, sensor.views
    sides = [image.width, image.height]
    for view in views.values():
        sides += [view.roi.x, view.roi.y, view.roi.width, view.roi.height]
    if any(side % 2 for side in sides):
        return None
    halves = {
        name: replace(
            view,
            roi=replace(
                view.roi,
                x=view.roi.x // 2,
                y=view.roi.y // 2,
                width=view.roi.width // 2,
                height=view.roi.height // 2,
            ),
            camera=_with_half_the_pixels(view.camera),
        )
        for name, view in views.items()
    }
    return replace(
        sensor,
        image=replace(image, width=image.width // 2, height=image.height // 2),
        camera=_with_half_the_pixels(sensor.camera),
        views=halves,
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


# The mechanics of a live sensor, on a thread of its own.

# After a pause the motion goes on from where it was, not from where it would be by now: a step
# counts for so many regular ones at most.
LONGEST_STEP = 3
# Share of the last steps in the average of their duration.
STEP_MEMORY = 0.9
# A scene's motion begins when so many pictures of the gel at rest were taken: in them a reference
# is found however slow the machine is, though some be lost and a count of frames be under way.
REST_PICTURES = 3 * RestParameters().rest_frames
Goal = Pose | Load | motion.LiveMode
"""PLAYING and HOLDING where there is no target."""


@dataclass(frozen=True)
class LiveState:
    """A solved contact, and what it does to the markers.

    number: of the step, from 0.  moved (rows, cols, 3) m: displacement of the observers.
    """

    number: int
    contact: ContactState
    moved: NDArray[np.float64]


class LiveContact:
    """Solves the contact of a scene step by step in real time.

    Commands and properties are for any thread.  A step that cannot be solved leaves the state as
    it was, with the reason in `status.problem`.
    """

    def __init__(self, scene: Scene, settings: motion.LiveSettings, rate: float) -> None:
        """scene: as it is to be simulated live.  rate: steps per second that are aimed at, Hz."""
        self._scene = scene
        self._rate = rate
        self._settings = settings
        self._lock = threading.Lock()
        self._first_goal = motion.LiveMode.PLAYING if settings.autoplay else motion.LiveMode.HOLDING
        self._goal: Goal = self._first_goal
        self._reset = False
        self._simulation: Simulation | None = None
        self._latest: LiveState | None = None
        self._note = self._problem = ""
        self._step_s = 0.0
        self._pictures = 0
        self._worker = Worker("mechanics", self._run)

    @property
    def latest(self) -> LiveState | None:
        """The newest state; None until the elastic model is built."""
        return self._latest

    def pictured(self, state: LiveState | None) -> None:
        """Know that a picture of that state was taken."""
        if state is not None and state is self._latest:
            self._pictures += 1

    @property
    def mode(self) -> motion.LiveMode:
        """What the indenter does."""
        if self._latest is None:
            return motion.LiveMode.BUILDING
        goal = self._goal
        if isinstance(goal, motion.LiveMode):
            return goal
        return motion.LiveMode.PRESSING if isinstance(goal, Load) else motion.LiveMode.MOVING

    @property
    def status(self) -> motion.LiveStatus:
        """How it is."""
        steps = 0 if self._latest is None else self._latest.number
        return motion.LiveStatus(self.mode, self._note, self._problem, steps, self._step_s)

    @property
    def failure(self) -> str:
        """Why nothing can be simulated at all; empty while it can."""
        return self._worker.failure

    @property
    def observers(self) -> SurfaceGrid | None:
        """The grid of `LiveState.moved`; None until there is a state."""
        return None if self._simulation is None else self._simulation.elastomer.observers

    def force_field(self, contact: ContactState) -> ForceField:
        """The true force field of one of its states."""
        assert self._simulation is not None  # noqa: S101  it made the state
        return force_field(self._simulation.contact, contact, self._scene.sensor)

    def start(self) -> None:
        """Begin to build and to solve."""
        self._worker.start()

    def stop(self) -> None:
        """End, and wait for the thread."""
        self._worker.stop()

    def command(self, command: motion.Command) -> None:
        """Do that from now on, at the rates of the settings."""
        with self._lock:
            if isinstance(command, motion.Reset):
                self._goal, self._reset = self._first_goal, True
            else:
                self._goal = command

    def _run(self) -> None:
        # Several threads of BLAS that wait for each other on a busy machine take ten times as long.
        with threadpool_limits(1, user_api="blas"):
            self._simulate()

    def _simulate(self) -> None:
        try:
            simulation = Simulation(self._scene, progress=self._on_progress)
        except _StoppedError:
            return
        self._simulation, player = simulation, motion.ScenePlayer(simulation)
        self._publish(player.contact)
        pacer, last = Pacer(), time.monotonic()
        while not self._worker.wait(pacer.delay(1 / self._rate)):
            now = time.monotonic()
            self._step(player, min(now - last, LONGEST_STEP / self._rate))
            last = now

    def _on_progress(self, what: str, share: float) -> None:
        self._note = f"{what}, {100 * share:.0f} %"
        if self._worker.stopping:
            raise _StoppedError

    def _step(self, player: motion.ScenePlayer, elapsed: float) -> None:
        with self._lock:
            goal, reset, self._reset = self._goal, self._reset, False
        if goal is motion.LiveMode.HOLDING and not reset and not self._creeps:
            return
        began = time.monotonic()
        try:
            contact, there = self._solve(player, None if reset else goal, elapsed)
        except SimulationError as error:
            self._problem = str(error)
            self._end(goal)
        else:
            self._publish(contact)
            # Only now, so that who sees it hold still sees the state in which it does.
            if there:
                self._end(goal)
        took = time.monotonic() - began
        self._step_s = STEP_MEMORY * self._step_s + (1 - STEP_MEMORY) * took

    def _solve(
        self, player: motion.ScenePlayer, goal: Goal | None, elapsed: float
    ) -> tuple[ContactState, bool]:
        """The next contact on the way to a goal, and whether it is there; None: the beginning."""
        if goal is None:
            return player.start(), False
        if goal is motion.LiveMode.PLAYING:
            if player.at_start and self._pictures < REST_PICTURES:
                return player.contact, False
            return player.step(elapsed), False
        assert self._simulation is not None  # noqa: S101
        assert self._latest is not None  # noqa: S101  published before the first step
        now = self._latest.contact
        if isinstance(goal, motion.LiveMode):
            return motion.stay(self._simulation, now, elapsed), False
        return motion.step_towards(self._simulation, now, goal, self._settings, elapsed)

    @property
    def _creeps(self) -> bool:
        return self._simulation is not None and self._simulation.elastomer.creeps

    def _end(self, goal: Goal) -> None:
        """Stay where it is, unless something else was asked for meanwhile or the scene plays."""
        with self._lock:
            if self._goal is goal and goal is not motion.LiveMode.PLAYING:
                self._goal = motion.LiveMode.HOLDING

    def _publish(self, contact: ContactState) -> None:
        assert self._simulation is not None  # noqa: S101
        latest = self._latest
        if latest is None or contact is not latest.contact:
            number = 0 if latest is None else latest.number + 1
            moved = self._simulation.elastomer.marker_displacement(contact.force)
            self._latest, self._pictures = LiveState(number, contact, moved), 0
        self._problem = ""


class _StoppedError(Exception):
    """Ends the building of a model that nobody waits for any more."""
