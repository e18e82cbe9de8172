"""Where the indenter is to be, or what it is to press with, in each frame of a scene."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.state import Load, Pose
from cmp_tactile_simulation.scenes.description import (
    Goal,
    Hold,
    MoveBy,
    MoveTo,
    Phase,
    Press,
    Release,
    Start,
    Touch,
    Vector,
)

__all__ = ["Motion", "PhaseStart", "goal_pose", "load_between", "start_pose", "turned"]


@dataclass(frozen=True)
class PhaseStart:
    """Pose and load at the beginning of a phase; what it reaches for is interpolated from them."""

    pose: Pose
    load: Load


class Motion:
    """The phases of a scene on the axis of frames."""

    def __init__(self, phases: Sequence[Phase]) -> None:
        self._phases = tuple(phases)
        self._ends = list(accumulate(phase.frames for phase in phases))

    def phase(self, frame: int) -> Phase:
        """The phase that a frame belongs to."""
        return self._phases[bisect_right(self._ends, frame)]

    def begins_phase(self, frame: int) -> bool:
        """Whether a frame is the first of its phase."""
        return frame == 0 or frame in self._ends

    def share(self, frame: int) -> float:
        """How far towards the phase's goal a frame is, 0 to 1; the last frame is there."""
        phase = self.phase(frame)
        last = self._ends[bisect_right(self._ends, frame)]
        share = 1.0 - (last - 1 - frame) / phase.frames
        return share if phase.easing == "linear" else share * share * (3.0 - 2.0 * share)


def turned(rotation_deg: Vector) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of turns about the fixed x, then y, then z direction, degrees."""
    return np.asarray(Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix())


def start_pose(start: Start, contact: ContactSimulation) -> Pose:
    """The pose before the first frame."""
    rotation = turned(start.rotation_deg)
    if isinstance(start.place, Touch):
        return _touching(start.place.at, start.place.clearance, rotation, contact)
    return Pose(np.array(start.place), rotation)


def goal_pose(goal: Goal, begin: Pose, contact: ContactSimulation) -> Pose:
    """The pose that a phase which begins at `begin` ends at; a load has none (ValueError)."""
    if isinstance(goal, Hold):
        return begin
    if isinstance(goal, MoveTo):
        position = begin.position if goal.position is None else np.array(goal.position)
        rotation = begin.rotation if goal.rotation_deg is None else turned(goal.rotation_deg)
        return Pose(position, rotation)
    if isinstance(goal, MoveBy):
        return Pose(begin.position + goal.offset, turned(goal.rotation_deg) @ begin.rotation)
    if isinstance(goal, Touch):
        return _touching(goal.at, goal.clearance, begin.rotation, contact)
    if isinstance(goal, Release):
        x, y, _ = begin.position.tolist()
        return _touching((x, y), goal.clearance, begin.rotation, contact)
    msg = f"found {goal!r}, expected a goal that is a place"
    raise ValueError(msg)


def load_between(begin: Load, goal: Press, share: float) -> Load:
    """The load at a share 0..1 of the way."""
    end = goal.load

    def between(first: float, last: float) -> float:
        return first + share * (last - first)

    return Load(
        normal=between(begin.normal, end.normal),
        tangential=(
            between(begin.tangential[0], end.tangential[0]),
            between(begin.tangential[1], end.tangential[1]),
        ),
        torque=between(begin.torque, end.torque),
    )


def _touching(
    at: tuple[float, float],
    clearance: float,
    rotation: NDArray[np.float64],
    contact: ContactSimulation,
) -> Pose:
    touching = contact.touch(Pose(np.array([*at, 0.0]), rotation))
    return Pose(touching.position + (0.0, 0.0, clearance), rotation)
