"""A scene, simulated frame by frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CmpTactileError, ContactError
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_simulation.contact.laws import ContactState, Load, Pose
from cmp_tactile_simulation.scenes import description
from cmp_tactile_simulation.simulator import SimulatedFrame, Simulator

# Frames that rendering may lag behind the mechanics.
FRAMES_AHEAD = 2


@dataclass(frozen=True)
class MechanicalState:
    """What the next frame depends on beside the elastomer's past; frame -1 is before the first."""

    frame: int
    contact: ContactState
    phase_start: description.PhaseStart


class Simulation:
    """Elastomer, indenter and camera of a scene, ready to run.

    cache_dir: of the elastomer's compliance.  progress: called with a text and the fraction done
    while it is built.  Raises ContactError for a scene that cannot be run.
    """

    def __init__(
        self,
        scene: description.Scene,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        self.scene = scene
        self._simulator = Simulator(
            scene.sensor,
            description.indenter_of(scene.indenter, scene.start),
            friction=scene.indenter.friction,
            look=scene.look,
            contact_nodes=scene.contact_nodes,
            cache_dir=cache_dir,
            progress=progress,
        )
        self.elastomer, self.contact = self._simulator.elastomer, self._simulator.contact
        self._motion = description.Motion(scene.motion)
        self._phase_end: tuple[description.PhaseStart, Pose] | None = None

    def start(self) -> MechanicalState:
        """The state before the first frame; ContactError where it is inside the gel."""
        self.elastomer.forget()
        pose = description.start_pose(self.scene.start, self.contact)
        return MechanicalState(-1, self.contact.rest(pose), description.PhaseStart(pose, Load(0.0)))

    def states(self, after: MechanicalState | None = None) -> Iterator[MechanicalState]:
        """The mechanics of all frames after the latest state, without pictures."""
        state = after or self.start()
        for frame in range(state.frame + 1, self.scene.frame_count):
            state = self._next(state, frame)
            yield state

    def frames(self) -> Generator[SimulatedFrame, None, None]:
        """All frames, in order.

        The mechanics of the next frames goes on while one is rendered.  Raises ContactError
        after the last frame that can be simulated, where that is not the scene's last.
        """
        state = self.start()
        pending: deque[Future[SimulatedFrame]] = deque()
        failure: CmpTactileError | None = None
        with ThreadPoolExecutor(1, thread_name_prefix="rendering") as pool:
            try:
                for frame in range(state.frame + 1, self.scene.frame_count):
                    state = self._next(state, frame)
                    with self._telling(frame):
                        moved = self.elastomer.marker_displacement(state.contact.force)
                    pending.append(pool.submit(self.observe, state, moved))
                    if len(pending) > FRAMES_AHEAD:
                        yield pending.popleft().result()
            except CmpTactileError as error:
                # The frames before are good.
                failure = error
            while pending:
                yield pending.popleft().result()
        if failure is not None:
            raise failure

    def observe(self, state: MechanicalState, moved: NDArray[np.float64]) -> SimulatedFrame:
        """The frame of a state, and what is true of it.

        moved (rows, cols, 3) m: displacement of the elastomer's observers.
        """
        return self._simulator.observe(
            state.contact,
            moved,
            state.frame,
            self.scene.stamp_ns(state.frame),
            self._motion.phase(state.frame).name,
        )

    @contextmanager
    def _telling(self, frame: int) -> Iterator[None]:
        """Let errors name the phase and the frame in which they come."""
        try:
            yield
        except ContactError as error:
            msg = f"phase {self._motion.phase(frame).name!r}, frame {frame}: {error}"
            raise ContactError(msg) from error

    def _next(self, state: MechanicalState, frame: int) -> MechanicalState:
        self.elastomer.advance(state.contact.force, 1 / self.scene.rate)
        with self._telling(frame):
            return self._solved(state, frame)

    def _solved(self, state: MechanicalState, frame: int) -> MechanicalState:
        begin = state.phase_start
        if self._motion.begins_phase(frame):
            begin = description.PhaseStart(
                state.contact.pose, self.contact.driven_load(state.contact)
            )
        goal, share = self._motion.phase(frame).goal, self._motion.share(frame)
        if isinstance(goal, description.Hold):
            contact = self.contact.move(state.contact, state.contact.pose)
        elif isinstance(goal, description.Press):
            contact = self.contact.press(
                state.contact, description.load_between(begin.load, goal, share)
            )
        else:
            end = self._end_of_phase(begin, goal)
            contact = self.contact.move(state.contact, begin.pose.towards(end, share))
        return MechanicalState(frame, contact, begin)

    def _end_of_phase(self, begin: description.PhaseStart, goal: description.Goal) -> Pose:
        """The goal's pose, worked out once: to look for where a mesh touches takes a second."""
        if self._phase_end is None or self._phase_end[0] is not begin:
            self._phase_end = begin, description.goal_pose(goal, begin.pose, self.contact)
        return self._phase_end[1]
