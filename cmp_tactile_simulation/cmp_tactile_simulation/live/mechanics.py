"""The mechanics of a live sensor: commands, and small steps towards them on its own thread."""

from __future__ import annotations

import math
import threading
import time
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from cmp_tactile_driver.sources.capture import Pacer, Worker
from cmp_tactile_processing.errors import CmpTactileError, InputError
from cmp_tactile_processing.measured import ForceField, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.surface.stillness import RestParameters
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.scenes.description import Press, Scene, load_between
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import force_field

HIGHEST_M = 0.1

# What turns and torques are compared with ways and forces by: about half a gel's side, m.
LEVER_M = 0.01
# Of sums of intervals, in frames.
ROUNDING = 1e-6
# Frames of a scene that are solved in one step at most: a slow machine plays in slow motion.
MOST_FRAMES = 4

# After a pause the motion goes on from where it was, not from where it would be by now: a step
# counts for so many regular ones at most.
LONGEST_STEP = 3
# Share of the last steps in the average of their duration.
STEP_MEMORY = 0.9
# A scene's motion begins when so many pictures of the gel at rest were taken: in them a reference
# is found however slow the machine is, though some be lost and a count of frames be under way.
REST_PICTURES = 3 * RestParameters().rest_frames


@dataclass(frozen=True)
class Reset:
    """Back to the beginning of the scene, the gel at rest."""


Command = Pose | Load | Reset
"""Go to a pose and stay there; press with a load and stay so; begin again."""


def check_command(command: Command, sensor: SensorDescription) -> None:
    """Raise InputError for an invalid pose or one out of reach, or a load not into the gel."""
    if isinstance(command, Pose):
        _check_pose(command, sensor)
    elif isinstance(command, Load):
        _check_load(command)


def _check_pose(pose: Pose, sensor: SensorDescription) -> None:
    if not (np.isfinite(pose.position).all() and np.isfinite(pose.rotation).all()):
        msg = "found a number that is not finite, expected a pose"
        raise InputError(msg)
    x, y, thickness = sensor.elastomer.size
    limits = ((-x / 2, x / 2), (-y / 2, y / 2), (-thickness, HIGHEST_M))
    for name, value, (low, high) in zip("xyz", pose.position.tolist(), limits, strict=True):
        if not low <= value <= high:
            msg = f"position.{name}: found {value:g} m, expected {low:g} to {high:g} m"
            raise InputError(msg)


def _check_load(load: Load) -> None:
    values = (load.normal, *load.tangential, load.torque)
    if not all(map(math.isfinite, values)):
        msg = f"found force and torque {values}, expected finite numbers"
        raise InputError(msg)
    if load.normal <= 0:
        msg = f"force.z: found {-load.normal:g} N, expected less than 0 (into the gel)"
        raise InputError(msg)


class LiveMode(Enum):
    """What the indenter does."""

    BUILDING = "building the elastic model"
    PLAYING = "playing the scene"
    MOVING = "moving to the target"
    PRESSING = "pressing with the load"
    HOLDING = "holding still"


@dataclass(frozen=True)
class LiveStatus:
    """How a live sensor is.

    note: how far the elastic model is built.  problem: why the last step could not be solved, or
    empty.  steps: states that were solved so far.  step_s: how long one takes to solve, averaged
    over the last ones, s.
    """

    mode: LiveMode = LiveMode.BUILDING
    note: str = ""
    problem: str = ""
    steps: int = 0
    step_s: float = 0.0


@dataclass(frozen=True)
class LiveSettings(Parameters, section="simulated"):
    """How a scene is simulated live."""

    autoplay: bool = parameter(True, "repeat the scene's motion until a target or load comes")
    max_speed: float = parameter(
        0.01, "highest speed of the indenter towards a target", unit="m/s", within=(1e-5, 1.0)
    )
    max_load_rate: float = parameter(
        10.0, "rate of the force towards a load", unit="N/s", within=(1e-3, 1e4)
    )
    contact_nodes: int = parameter(
        24, "number of contact nodes along each side, unless the scene has fewer", within=(8, 100)
    )
    samples: int = parameter(
        1, "number of samples of a pixel along each side, unless the scene has fewer", within=(1, 8)
    )


def step_towards(
    simulation: Simulation,
    now: ContactState,
    goal: Pose | Load,
    settings: LiveSettings,
    elapsed: float,
) -> tuple[ContactState, bool]:
    """The contact `elapsed` s later on the way to a pose or load, and whether it is there.

    Raises ContactError where the contact cannot be solved.
    """
    simulation.elastomer.advance(now.force, elapsed)
    if isinstance(goal, Load):
        begin = simulation.contact.driven_load(now)
        share = _share(settings.max_load_rate * elapsed, _load_distance(begin, goal))
        contact = simulation.contact.press(now, load_between(begin, Press(goal), share))
    else:
        share = _share(settings.max_speed * elapsed, _way(now.pose, goal))
        contact = simulation.contact.move(now, now.pose.towards(goal, share))
    return contact, share >= 1.0


def stay(simulation: Simulation, now: ContactState, elapsed: float) -> ContactState:
    """The contact `elapsed` s later, the indenter where it is.

    Raises ContactError where the contact cannot be solved.
    """
    simulation.elastomer.advance(now.force, elapsed)
    return simulation.contact.move(now, now.pose)


class ScenePlayer:
    """Plays the motion of a scene again and again, in real time where the mechanics keep up."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._state = simulation.start()
        self._due = 0.0

    @property
    def contact(self) -> ContactState:
        """The contact of the frame that was played last; the gel at rest before the first."""
        return self._state.contact

    @property
    def at_start(self) -> bool:
        """Whether no frame was played since the beginning."""
        return self._state.frame < 0

    def start(self) -> ContactState:
        """Back to the beginning: the contact before the first frame."""
        self._state, self._due = self._simulation.start(), 0.0
        return self._state.contact

    def step(self, elapsed: float) -> ContactState:
        """The contact `elapsed` s later.

        Raises ContactError where a frame cannot be solved; the next step passes it over.
        """
        self._due += elapsed * self._simulation.scene.rate
        if self._state.frame + 1 >= self._simulation.scene.frame_count:
            return self.start()
        # Frame k ends k + 1 frames' times after the beginning.
        last, end = self._state.frame, self._simulation.scene.frame_count
        due = min(math.floor(self._due + ROUNDING) - 1, last + MOST_FRAMES, end - 1)
        for frame in range(last + 1, due + 1):
            self._play(frame)
        self._due = min(self._due, self._state.frame + 2.0)
        return self._state.contact

    def _play(self, frame: int) -> None:
        try:
            self._state = next(self._simulation.states(self._state))
        except CmpTactileError:
            self._state = replace(self._state, frame=frame)
            raise


def _share(possible: float, whole: float) -> float:
    return 1.0 if whole <= possible else possible / whole


def _way(begin: Pose, end: Pose) -> float:
    turn = Rotation.from_matrix(begin.rotation.T @ end.rotation).magnitude()
    return max(float(np.linalg.norm(end.position - begin.position)), float(turn) * LEVER_M)


def _load_distance(begin: Load, end: Load) -> float:
    forces = np.subtract((begin.normal, *begin.tangential), (end.normal, *end.tangential))
    return max(float(np.linalg.norm(forces)), abs(end.torque - begin.torque) / LEVER_M)


Goal = Pose | Load | LiveMode
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

    def __init__(self, scene: Scene, settings: LiveSettings, rate: float) -> None:
        """scene: as it is to be simulated live.  rate: steps per second that are aimed at, Hz."""
        self._scene = scene
        self._rate = rate
        self._settings = settings
        self._lock = threading.Lock()
        self._first_goal = LiveMode.PLAYING if settings.autoplay else LiveMode.HOLDING
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
    def mode(self) -> LiveMode:
        """What the indenter does."""
        if self._latest is None:
            return LiveMode.BUILDING
        goal = self._goal
        if isinstance(goal, LiveMode):
            return goal
        return LiveMode.PRESSING if isinstance(goal, Load) else LiveMode.MOVING

    @property
    def status(self) -> LiveStatus:
        """How it is."""
        steps = 0 if self._latest is None else self._latest.number
        return LiveStatus(self.mode, self._note, self._problem, steps, self._step_s)

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

    def command(self, command: Command) -> None:
        """Do that from now on, at the rates of the settings."""
        with self._lock:
            if isinstance(command, Reset):
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
        except CancelledError:
            return
        self._simulation, player = simulation, ScenePlayer(simulation)
        self._publish(player.contact)
        pacer, last = Pacer(), time.monotonic()
        while not self._worker.wait(pacer.delay(1 / self._rate)):
            now = time.monotonic()
            self._step(player, min(now - last, LONGEST_STEP / self._rate))
            last = now

    def _on_progress(self, what: str, share: float) -> None:
        self._note = f"{what}, {100 * share:.0f} %"
        if self._worker.stopping:
            raise CancelledError

    def _step(self, player: ScenePlayer, elapsed: float) -> None:
        with self._lock:
            goal, reset, self._reset = self._goal, self._reset, False
        if goal is LiveMode.HOLDING and not reset and not self._creeps:
            return
        began = time.monotonic()
        try:
            contact, there = self._solve(player, None if reset else goal, elapsed)
        except CmpTactileError as error:
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
        self, player: ScenePlayer, goal: Goal | None, elapsed: float
    ) -> tuple[ContactState, bool]:
        """The next contact on the way to a goal, and whether it is there; None: the beginning."""
        if goal is None:
            return player.start(), False
        if goal is LiveMode.PLAYING:
            if player.at_start and self._pictures < REST_PICTURES:
                return player.contact, False
            return player.step(elapsed), False
        assert self._simulation is not None  # noqa: S101
        assert self._latest is not None  # noqa: S101  published before the first step
        now = self._latest.contact
        if isinstance(goal, LiveMode):
            return stay(self._simulation, now, elapsed), False
        return step_towards(self._simulation, now, goal, self._settings, elapsed)

    @property
    def _creeps(self) -> bool:
        return self._simulation is not None and self._simulation.elastomer.creeps

    def _end(self, goal: Goal) -> None:
        """Stay where it is, unless something else was asked for meanwhile or the scene plays."""
        with self._lock:
            if self._goal is goal and goal is not LiveMode.PLAYING:
                self._goal = LiveMode.HOLDING

    def _publish(self, contact: ContactState) -> None:
        assert self._simulation is not None  # noqa: S101
        latest = self._latest
        if latest is None or contact is not latest.contact:
            number = 0 if latest is None else latest.number + 1
            moved = self._simulation.elastomer.marker_displacement(contact.force)
            self._latest, self._pictures = LiveState(number, contact, moved), 0
        self._problem = ""
