"""The mechanics of a live sensor, on a thread of its own."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_driver.sources.timing import Pacer
from cmp_tactile_driver.sources.worker import Worker
from cmp_tactile_processing.measured import ForceField, SurfaceGrid
from cmp_tactile_processing.surface.stillness import RestParameters
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.live import motion
from cmp_tactile_simulation.live.exchange import Command, LiveMode, LiveStatus, Reset
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.simulation import Simulation, force_field

# After a pause the motion goes on from where it was, not from where it would be by now: a step
# counts for so many regular ones at most.
LONGEST_STEP = 3
# Share of the last steps in the average of their duration.
STEP_MEMORY = 0.9
# A scene's motion begins when so many pictures of the gel at rest were taken: in them a reference
# is found however slow the machine is, though some be lost and a count of frames be under way.
REST_PICTURES = 3 * RestParameters().rest_frames
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

    def __init__(self, scene: Scene, settings: motion.LiveSettings, rate: float) -> None:
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
        if goal is LiveMode.HOLDING and not reset and not self._creeps:
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
        if goal is LiveMode.PLAYING:
            if player.at_start and self._pictures < REST_PICTURES:
                return player.contact, False
            return player.step(elapsed), False
        assert self._simulation is not None  # noqa: S101
        assert self._latest is not None  # noqa: S101  published before the first step
        now = self._latest.contact
        if isinstance(goal, LiveMode):
            return motion.stay(self._simulation, now, elapsed), False
        return motion.step_towards(self._simulation, now, goal, self._settings, elapsed)

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


class _StoppedError(Exception):
    """Ends the building of a model that nobody waits for any more."""
