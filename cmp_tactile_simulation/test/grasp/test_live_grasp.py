"""A grasp in real time, moved by its scene or by a controller; and its node over real DDS."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_simulation.grasp.live import COMMAND, LiveGrasp, LiveGraspSettings
from cmp_tactile_simulation.grasp.play import Grasp
from cmp_tactile_simulation.grasp.scene import (
    SIDES,
    GraspPhase,
    GraspScene,
    Servo,
    load_grasp,
)
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


# Two fingers that swing in by one servo, so that the opening is no linear function of its control.
SWINGING = """<mujoco><compiler angle="radian"/><option integrator="implicitfast"/><worldbody>
  <geom type="plane" size="1 1 0.1"/>
  <body name="hand" pos="0 0 0.13" gravcomp="1">
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
    <joint name="lift" type="slide" axis="0 0 1"/>
    <body name="left_finger" pos="0 -0.015 0" gravcomp="1">
      <inertial mass="0.02" pos="0 0 -0.1" diaginertia="1e-5 1e-5 1e-5"/>
      <joint name="left" axis="1 0 0" range="-0.4 0.2" armature="0.001" damping="0.02"/>
      <site name="left" pos="0 0 -0.1" xyaxes="-1 0 0 0 0 1"/>
    </body>
    <body name="right_finger" pos="0 0.015 0" gravcomp="1">
      <inertial mass="0.02" pos="0 0 -0.1" diaginertia="1e-5 1e-5 1e-5"/>
      <joint name="right" axis="-1 0 0" range="-0.4 0.2" armature="0.001" damping="0.02"/>
      <site name="right" pos="0 0 -0.1" xyaxes="-1 0 0 0 0 -1"/>
    </body>
  </body></worldbody>
  <equality><joint joint1="left" joint2="right" solref="0.005 1"/></equality>
  <actuator><position name="lift" joint="lift" kp="50000" kv="800"/>
    <general name="servo" joint="left" biastype="affine" gainprm="10" biasprm="0 -20 -0.5"/>
  </actuator>
  <keyframe><key name="open" qpos="0 -0.2 -0.2" ctrl="0 -0.4"/></keyframe></mujoco>"""


def test_controller_moves_the_fingers_of_another_hand(box: GraspScene, tmp_path: Path) -> None:
    """Of the servo, only the controls of open and closed fingers are known."""
    (tmp_path / "hand.xml").write_text(SWINGING)
    servo = Servo(open={"servo": -0.4}, closed={"servo": 0.2}, held=1.0)
    motion = (
        GraspPhase(name="close", duration=0.4, controls={"servo": 0.1}),
        GraspPhase(name="lift", duration=0.4, controls={"lift": 0.01}),
        GraspPhase(name="open", duration=0.4, controls={"servo": -0.4}),
    )
    changes = {"model": "hand.xml", "file": tmp_path / "scene.yaml", "keyframe": "open"}
    scene = replace(box, motion=motion, servo=servo, mass=0.05, **changes)
    grasp = started(scene, drive=COMMAND)
    begin = grasp.opening
    # Fingers of 100 mm that are turned by 0.2 rad, 30 mm apart.
    assert begin == pytest.approx(np.cos(0.2) * (0.03 + 0.2 * np.sin(0.2)), abs=1e-4)
    grasp.advance(0.6)
    assert grasp.phase == "close"
    assert grasp.opening == pytest.approx(begin, abs=1e-4)
    for wanted in (0.05, 0.04):
        grasp.command = wanted
        grasp.advance(1.0)
        # Between the 33 controls whose opening is known.
        assert grasp.opening == pytest.approx(wanted, abs=2e-5)
    assert max(grasp.grips) == 0.0
    grasp.command = 0.02
    advanced(grasp, "lift")
    assert min(grasp.grips) > servo.held
    advanced(grasp, "open")
    grasp.advance(0.35)
    assert max(grasp.grips) == 0.0
    # What only shapes the hand does not wait, and what closes again is the controller's.
    shape = GraspPhase(name="shape", duration=0.1, controls={"servo": -0.3})
    scene = replace(scene, motion=(shape, *motion, *motion))
    grasp = started(scene, drive=COMMAND)
    grasp.command = 0.02
    for phase in ("close", "lift", "open", "close"):
        advanced(grasp, phase)
    assert max(grasp.grips) == 0.0
    advanced(grasp, "lift")
    assert min(grasp.grips) > servo.held
    opens = replace(servo, open=servo.closed, closed=servo.open)
    with pytest.raises(InputError, match=r"servo: found openings of 10\.\d mm where open"):
        started(replace(scene, servo=opens), drive=COMMAND)
    with pytest.raises(InputError, match=r"servo\.open: found the actuator thumb, expected one"):
        started(replace(scene, servo=Servo(open={"thumb": 0.0}, closed={"thumb": 1.0})))


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
