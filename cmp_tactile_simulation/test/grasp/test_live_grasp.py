"""A grasp in real time, moved by its scene or by a controller; and its node over real DDS."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_simulation.grasp.live import COMMAND, LiveGrasp, LiveGraspSettings
from cmp_tactile_simulation.grasp.play import Grasp
from cmp_tactile_simulation.grasp.scene import SIDES, GraspPhase, GraspScene, load_grasp
from cmp_tactile_simulation.live.mechanics import REST_PICTURES

pytest.importorskip("mujoco")

CHUNK_S = 0.01
NODES = 16


@pytest.fixture(scope="module")
def box() -> GraspScene:
    motion = (
        GraspPhase(name="close", duration=0.4, grip=2.0),
        GraspPhase(name="lift", duration=0.4, lift=0.01),
        GraspPhase(name="open", duration=0.3, grip=-1.0, lift=0.0),
    )
    return replace(load_grasp("box"), contact_nodes=NODES, motion=motion, rate=10.0)


def started(scene: GraspScene, **settings: object) -> LiveGrasp:
    """A grasp whose sensors have taken their references."""
    grasp = LiveGrasp(scene, LiveGraspSettings(**settings))  # type: ignore[arg-type]
    for _ in range(REST_PICTURES):
        assert grasp.phase == "taking references"
        grasp.advance(CHUNK_S)
        grasp.taken += 1
    return grasp


def seen(grasp: LiveGrasp) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The left finger's picture, and where the object is."""
    moment = grasp.moment()
    return grasp.pictures(moment)["left"].astype(int), moment.held.position


def advanced(grasp: LiveGrasp, until: str, most_s: float = 5.0) -> None:
    for _ in range(round(most_s / CHUNK_S)):
        if grasp.phase == until:
            return
        grasp.advance(CHUNK_S)
    pytest.fail(f"{grasp.phase} after {most_s} s, expected {until}")


def test_live_grasp_is_the_recorded_one(box: GraspScene) -> None:
    """The same world, in other steps: forces at the end of a phase agree to 1 %."""
    recorded = {}
    for frame in Grasp(box, pictures=False).frames():
        recorded[frame.phase] = frame
    live = started(box, loop=False)
    advanced(live, "open")
    true = live.wrenches()
    # The last recorded frame of the lift is up to a tenth of a second earlier, where it is at rest.
    for side in SIDES:
        assert true[side][2] == pytest.approx(recorded["lift"].wrenches[side][2], rel=0.01)


def test_controller_moves_the_fingers_and_the_motion_waits_for_it(box: GraspScene) -> None:
    grasp = started(box, drive=COMMAND)
    begin = grasp.opening
    grasp.advance(1.0)
    assert grasp.phase == "close"
    assert grasp.opening == pytest.approx(begin, abs=1e-5)
    grasp.command = begin - 0.004
    grasp.advance(1.0)
    # Nothing is touched yet: a servo has no steady error.
    assert grasp.opening == pytest.approx(grasp.command, abs=1e-5)
    assert max(grasp.grips) == 0.0
    # 15 mm is the half width of the box; gel and servo give way.
    grasp.command = 2 * 0.015 - 0.0012
    advanced(grasp, "lift")
    assert min(grasp.grips) > 1.0
    # At the end the hand opens against the command.
    advanced(grasp, "open")
    grasp.advance(0.25)
    assert max(grasp.grips) == 0.0


def test_time_passes_as_asked(box: GraspScene) -> None:
    """A chunk of 1 / 30 s in thirds has 22.2 of MuJoCo's steps."""
    grasp = started(box, loop=False)
    begin = grasp.phase
    chunks = 0
    while grasp.phase == begin:
        grasp.advance(1 / 90)
        chunks += 1
    assert chunks / 90 == pytest.approx(0.4, abs=1 / 90)


def test_restart_begins_with_a_gel_that_was_never_touched(box: GraspScene) -> None:
    grasp = started(box)
    at_rest, before = seen(grasp)
    advanced(grasp, "lift")
    assert np.abs(seen(grasp)[0] - at_rest).max() > 100
    grasp.restart()
    again, after = seen(grasp)
    # It settles on the table by a tenth of a millimetre.
    assert after == pytest.approx(before, abs=2e-4)
    assert max(grasp.grips) == 0.0
    # Camera noise is a few grey levels.
    assert np.abs(again - at_rest).max() < 40
