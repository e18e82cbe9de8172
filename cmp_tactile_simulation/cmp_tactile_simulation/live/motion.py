"""How a live indenter moves: in small steps towards a target or load, or as its scene says."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.scenes.description import Press, Scene, load_between
from cmp_tactile_simulation.scenes.simulation import MechanicalState, Simulation

# What turns and torques are compared with ways and forces by: about half a gel's side, m.
LEVER_M = 0.01
# Of sums of intervals, in frames.
ROUNDING = 1e-6


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

    Raises SimulationError where the contact cannot be solved.
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

    Raises SimulationError where the contact cannot be solved.
    """
    simulation.elastomer.advance(now.force, elapsed)
    return simulation.contact.move(now, now.pose)


class ScenePlayer:
    """Plays the motion of a scene again and again, in real time where the mechanics keep up.

    Where they do not, frames within a phase are passed over, but never the first or last of one.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._limits = phase_limits(simulation.scene)
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

        Raises SimulationError where a frame cannot be solved; the next step passes it over.
        """
        self._due += elapsed * self._simulation.scene.rate
        if self._state.frame + 1 >= self._simulation.scene.frame_count:
            return self.start()
        # Frame k ends k + 1 frames' times after the beginning.
        due = math.floor(self._due + ROUNDING) - 1
        if due <= self._state.frame:
            return self._state.contact
        frame = next_frame(self._state.frame, due, self._limits)
        try:
            self._state = self._solve(frame)
        except SimulationError:
            self._state = replace(self._state, frame=frame)
            raise
        # What could not be kept up with is not made good later.
        self._due = min(self._due, frame + 2.0)
        return self._state.contact

    def _solve(self, frame: int) -> MechanicalState:
        passed_over = frame - self._state.frame - 1
        if passed_over > 0:
            seconds = passed_over / self._simulation.scene.rate
            self._simulation.elastomer.advance(self._state.contact.force, seconds)
        return next(self._simulation.states(replace(self._state, frame=frame - 1)))


def phase_limits(scene: Scene) -> tuple[int, ...]:
    """The first and the last frame of each phase, in order."""
    ends = accumulate(phase.frames for phase in scene.motion)
    limits = {
        frame
        for phase, end in zip(scene.motion, ends, strict=True)
        for frame in (end - phase.frames, end - 1)
    }
    return tuple(sorted(limits))


def next_frame(last: int, due: int, limits: tuple[int, ...]) -> int:
    """The frame to solve after `last` when `due` is due: that, or the limit before it."""
    limit = next(frame for frame in limits if frame > last)
    return max(last + 1, min(due, limit))


def _share(possible: float, whole: float) -> float:
    return 1.0 if whole <= possible else possible / whole


def _way(begin: Pose, end: Pose) -> float:
    turn = Rotation.from_matrix(begin.rotation.T @ end.rotation).magnitude()
    return max(float(np.linalg.norm(end.position - begin.position)), float(turn) * LEVER_M)


def _load_distance(begin: Load, end: Load) -> float:
    forces = np.subtract((begin.normal, *begin.tangential), (end.normal, *end.tangential))
    return max(float(np.linalg.norm(forces)), abs(end.torque - begin.torque) / LEVER_M)
