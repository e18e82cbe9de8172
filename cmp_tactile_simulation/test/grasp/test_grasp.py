"""A gripper with two gels in MuJoCo, against the laws of mechanics and of friction."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_processing.cache.files import packaged_files
from cmp_tactile_processing.errors import ContactError, InputError, OutputError
from cmp_tactile_simulation.grasp import world
from cmp_tactile_simulation.grasp.play import Grasp, GraspFrame, motion_of
from cmp_tactile_simulation.grasp.record import record_grasp
from cmp_tactile_simulation.grasp.scene import (
    SIDES,
    Fingertip,
    GraspPhase,
    GraspScene,
    load_grasp,
    packaged_grasps,
)

pytest.importorskip("mujoco")

GRAVITY = 9.81
CLOSE = GraspPhase(name="close", duration=0.4, grip=3.0)
LIFT = GraspPhase(name="lift", duration=0.4, lift=0.02)
HOLD = GraspPhase(name="hold", duration=0.3)


@pytest.fixture(scope="module")
def box() -> GraspScene:
    """The packaged box on coarser gels, which are solved quickly."""
    return replace(load_grasp("box"), contact_nodes=16, rate=100.0)


def played(scene: GraspScene, motion: Sequence[GraspPhase], **changes: object) -> Grasp:
    return Grasp(replace(scene, motion=tuple(motion), **changes), pictures=False)  # type: ignore[arg-type]


def force_on_object(frame: GraspFrame) -> NDArray[np.float64]:
    """Of both gels, (3,) N, world frame."""
    parts = [frame.fingertips[side].rotation @ frame.wrenches[side][:3] for side in SIDES]
    return -np.sum(parts, axis=0)


def test_held_object_is_in_balance_and_is_moved_by_the_gels_alone(box: GraspScene) -> None:
    """At rest within 1 % of the weight; while it is shaken within 2 % of the largest force."""
    shake = GraspPhase(name="shake", duration=0.6, shake=0.004, shake_hz=5.0)
    frames = list(played(box, [CLOSE, LIFT, HOLD, shake], rate=200.0).frames())
    weight = np.array([0.0, 0.0, box.mass * GRAVITY])
    held = [frame for frame in frames if frame.phase == "hold"][-1]
    assert np.linalg.norm(force_on_object(held) - weight) < 0.01 * weight[2]

    moved = [frame for frame in frames if frame.phase == "shake"]
    place = np.array([frame.held.position for frame in moved])
    acceleration = (place[2:] - 2 * place[1:-1] + place[:-2]) * 200.0**2
    force = np.array([force_on_object(frame) for frame in moved])[1:-1]
    missed = force - weight - box.mass * acceleration
    assert np.sqrt((missed**2).sum(axis=1).mean()) < 0.02 * np.abs(force[:, 0]).max()


@pytest.mark.parametrize("friction", [0.3, 0.8])
def test_object_slips_where_friction_ends(box: GraspScene, friction: float) -> None:
    """Two fingers hold 2 mu N: a grip that eases off lets go within 3 % of the weight."""
    least = box.mass * GRAVITY / 2 / friction
    firm = replace(CLOSE, grip=1.4 * least)
    ease = GraspPhase(name="ease", duration=1.5, grip=0.85 * least)
    body = replace(box.object, friction=friction)
    frames = played(box, [firm, LIFT, HOLD, ease], object=body).frames()
    before = math.inf
    for frame in frames:
        height = float(frame.held.position[2])
        # Faster than the gel can creep as its load changes.
        if frame.phase == "ease" and before - height > 2e-5:
            break
        before = height
    assert -frame.wrenches["left"][2] == pytest.approx(least, rel=0.03)


def test_object_turns_about_the_grip_where_coulomb_says(box: GraspScene) -> None:
    """The torque at which both contacts slide everywhere, against mu p r over the contact."""
    torque = 0.016
    turn = GraspPhase(name="turn", duration=1.5, torque=(0.0, torque, 0.0))
    grasp = played(box, [CLOSE, LIFT, HOLD, turn], mass=0.005)
    largest, start = 0.0, 0.0
    for frame in grasp.frames():
        if frame.phase != "turn":
            start = float(frame.index + 1)
            continue
        states = [grasp.world.touch(number).state for number in range(2)]
        if all(state.slipping.sum() == state.contact.sum() for state in states):
            break
        nodes = grasp.fingers["left"].elastomer.node_position
        pressing = -states[0].force[:, 2]
        place = (nodes + states[0].displacement)[:, :2]
        arm = np.linalg.norm(place - pressing @ place / pressing.sum(), axis=1)
        largest = 2 * box.object.friction * float(pressing @ arm)
    share = (frame.index - start) / (1.5 * box.rate)
    applied = torque * share**2 * (3 - 2 * share)
    # A step of the torque is up to 1.6 % of it.
    assert applied == pytest.approx(largest, rel=0.03)


def test_fingers_that_slide_along_the_object_are_followed(box: GraspScene) -> None:
    """A hand that goes on down over a box on the table: friction of mu N all the way, within 1 %.

    All of both contacts slides, so that no force changes on the way.
    """
    lower = GraspPhase(name="lower", duration=1.0, lift=-0.016)
    frames = list(played(box, [CLOSE, lower], rate=5.0).frames())[4:]
    begin, end = (frame.fingertips["left"].position[2] for frame in (frames[0], frames[-1]))
    assert begin - end > 0.004
    for frame in frames:
        for side in SIDES:
            x, y, z, *_ = frame.wrenches[side]
            assert math.hypot(x, y) == pytest.approx(-box.object.friction * z, rel=0.01)


def test_fingers_can_have_other_sensors(box: GraspScene, tmp_path: Path) -> None:
    """A gel twice as stiff is pressed in as far as the other by half the force."""
    content = yaml.safe_load(box.files["left"].read_text(encoding="utf-8"))
    gel = content["elastomer"]
    gel["young"] *= 2
    gel["shading_layer"]["young"] *= 2
    (tmp_path / "stiff.yaml").write_text(yaml.safe_dump({**content, "name": "stiff"}))
    path = tmp_path / "scene.yaml"
    keys = yaml.safe_load(box.file.read_text(encoding="utf-8"))
    path.write_text(yaml.safe_dump({**keys, "sensors": {"right": "stiff.yaml"}}))
    mixed = replace(load_grasp(str(path)), contact_nodes=16)
    assert [sensor.name for sensor in mixed.described.values()] == ["sample_rig", "stiff"]

    def pressed(grip: float, side: str) -> float:
        grasp = played(mixed, [replace(CLOSE, grip=grip), HOLD])
        *_, last = grasp.frames()
        assert -last.wrenches[side][2] == pytest.approx(grip, rel=0.01)
        return float(grasp.world.touch(SIDES.index(side)).state.displacement[:, 2].min())

    assert pressed(3.0, "right") == pytest.approx(pressed(1.5, "left"), rel=0.01)
    path.write_text(yaml.safe_dump({**keys, "sensors": {"right": "nowhere"}}))
    with pytest.raises(InputError, match=r"sensors\.right: found 'nowhere'"):
        load_grasp(str(path))


def test_recorded_grasp_holds_both_sensors_with_truth(box: GraspScene, tmp_path: Path) -> None:
    scene = replace(box, motion=(CLOSE, LIFT), rate=5.0)
    shares: list[float] = []
    summary = record_grasp(Grasp(scene), tmp_path / "out", shares.append)
    assert shares[-1] == 1.0
    topics = BagStorage(tmp_path / "out").topics
    expected = {"/object/pose", "/gripper/controls", "/tf"}
    for side in SIDES:
        expected |= {f"/{side}/{name}" for name in ("wrench", "force_field", "truth/wrench")}
        expected |= {f"/{side}/image_raw/compressed", f"/{side}/truth/surface"}
    assert expected <= topics.keys()
    (marker,) = BagStorage(tmp_path / "out").decoded(["/object/marker"])
    corners = np.array([[corner.x, corner.y, corner.z] for corner in marker.points])
    assert (marker.type, marker.header.frame_id) == (marker.TRIANGLE_LIST, "object")
    np.testing.assert_allclose(np.ptp(corners, axis=0), box.object.values["size"])
    with (tmp_path / "out" / "wrenches.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * summary.frames == 2 * 4
    # Of 3 N; the chain knows the gel, and sees it in 2 x 2 samples of a pixel.
    pressed = [row for row in rows if float(row["fz_true"]) < -1]
    assert pressed
    for row in pressed:
        assert float(row["fz"]) == pytest.approx(float(row["fz_true"]), rel=0.02)
    video = cv2.VideoCapture(str(tmp_path / "out" / "grasp.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) == summary.frames
    with pytest.raises(OutputError, match="exists already"):
        record_grasp(Grasp(scene), tmp_path / "out", shares.append)


def test_grasp_that_cannot_go_on_leaves_the_frames_before(box: GraspScene, tmp_path: Path) -> None:
    push = GraspPhase(name="push", duration=0.5, force=(0.0, 0.0, 1e14))
    scene = replace(box, motion=(CLOSE, push), rate=5.0)
    summary = record_grasp(Grasp(scene), tmp_path / "out", lambda _: None)
    assert "push: " in summary.ended
    with (tmp_path / "out" / "wrenches.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * summary.frames
    assert 2 <= summary.frames <= 3


def test_own_model_grasps(box: GraspScene, tmp_path: Path) -> None:
    """A user's MJCF: the packaged gripper with an object of its own and another servo."""
    text = packaged_files("cmp_tactile_simulation", "grasps/*.xml")["gripper"].read_text()
    body = '<body name="object" pos="0 0 0.03"><freejoint/><geom type="box" '
    body += 'size="0.02 0.015 0.03" mass="0.1"/></body></worldbody>'
    (tmp_path / "mine.xml").write_text(text.replace("</worldbody>", body))
    scene = replace(box, model="mine.xml", file=tmp_path / "scene.yaml")
    speed = {"grip_left": 0.03, "grip_right": 0.03}
    close = GraspPhase(name="close", duration=2.5, controls=speed)
    frames = list(played(scene, [close], rate=5.0).frames())
    # The model's own limit of the grip's force is 10 N: it ends before the gel's patch does.
    assert frames[-1].wrenches["left"][2] < -0.5
    wrong = GraspPhase(name="turn", duration=0.1, controls={"no_such": 1.0})
    with pytest.raises(InputError, match=r"motion\[1\], turn: found the actuator no_such"):
        played(scene, [close, wrong])
    (tmp_path / "mine.xml").write_text(text.replace('site name="left"', 'site name="other"'))
    with pytest.raises(InputError, match=r"other.*expected left"):
        played(scene, [close])
    (tmp_path / "mine.xml").write_text("<mujoco><nothing/></mujoco>")
    with pytest.raises(InputError, match=r"mine\.xml"):
        played(scene, [close])


# As hands come in collections of models: no sites, no object, one servo for both fingers.
HAND = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <geom type="plane" size="1 1 0.1"/>
  <body name="hand" pos="0 0 0.13" quat="0 1 0 0" gravcomp="1">
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
    <joint name="lift" type="slide" axis="0 0 -1"/>
    <body name="left_finger" pos="0 0 0.06" gravcomp="1">
      <inertial mass="0.015" pos="0 0 0" diaginertia="2e-6 2e-6 1e-6"/>
      <joint name="left" type="slide" axis="0 1 0" range="0 0.04" armature="0.1" damping="1"/>
      <geom type="box" size="0.0085 0.004 0.0085" pos="0 0.0055 0.04"/>
    </body>
    <body name="right_finger" pos="0 0 0.06" quat="0 0 0 1" gravcomp="1">
      <inertial mass="0.015" pos="0 0 0" diaginertia="2e-6 2e-6 1e-6"/>
      <joint name="right" type="slide" axis="0 1 0" range="0 0.04" armature="0.1" damping="1"/>
      <geom type="box" size="0.0085 0.004 0.0085" pos="0 0.0055 0.04"/>
    </body>
  </body></worldbody>
  <tendon><fixed name="both"><joint joint="left" coef="0.5"/><joint joint="right" coef="0.5"/>
  </fixed></tendon>
  <equality><joint joint1="left" joint2="right" solref="0.005 1"/></equality>
  <actuator><position name="lift" joint="lift" kp="50000" kv="800"/>
    <general name="fingers" tendon="both" biastype="affine" gainprm="1" biasprm="0 -400 -10"
      forcerange="-100 100"/></actuator>
  <keyframe><key name="open" qpos="0 0.03 0.03" ctrl="0 12"/></keyframe></mujoco>"""


def test_hand_without_sites_and_object_holds_the_scenes_object(
    box: GraspScene, tmp_path: Path
) -> None:
    """The scene says where the gels are, and adds what is held; the hand begins at a keyframe."""
    (tmp_path / "hand.xml").write_text(HAND)
    tips = {
        side: Fingertip(body=f"{side}_finger", pos=(0, 0, 0.04), xyaxes=(1, 0, 0, 0, 0, 1))
        for side in SIDES
    }
    changes = {"model": "hand.xml", "file": tmp_path / "scene.yaml", "mass": 0.1, "rate": 50.0}
    changes |= {"keyframe": "open", "fingertips": tips}
    close = GraspPhase(name="close", duration=0.6, controls={"fingers": 0.0})
    lift = GraspPhase(name="lift", duration=0.4, controls={"lift": 0.02})
    *_, last = played(box, [close, lift, HOLD], **changes).frames()
    # The servo pulls with 400 N/m on half of each finger's way of 15 mm.
    for side in SIDES:
        assert -last.wrenches[side][2] == pytest.approx(400 * 0.015 / 2, rel=0.05)
    weight = 0.1 * GRAVITY
    assert np.linalg.norm(force_on_object(last) - (0, 0, weight)) < 0.01 * weight
    assert last.held.position[2] == pytest.approx(0.05, abs=1e-3)
    with pytest.raises(InputError, match=r"hand, left_finger.*expected thumb"):
        played(box, [close], **{**changes, "fingertips": {"left": Fingertip(body="thumb")}})
    with pytest.raises(InputError, match="found the key names open, expected home"):
        played(box, [close], **{**changes, "keyframe": "home"})


def test_packaged_grasps_can_be_read() -> None:
    scenes = [load_grasp(name) for name in packaged_grasps()]
    assert len(scenes) >= 5
    assert all(scene.title and scene.duration > 1 for scene in scenes)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("cuboid", "sphere_group", r"object\.type"),
        ("mass: 0.15", "mass: -1", "mass"),
        ("duration: 0.5, grip: 3.0", "grip: 3.0", r"motion\[0\]\.duration"),
        ("lift: 0.04", "lyft: 0.04", "lyft"),
        ("title:", "sensor: nowhere\ntitle:", "sensor"),
        ("title:", "fingertips: {left: {body: finger}}\ntitle:", "fingertips.*without a model"),
        ("title:", "model: box.yaml\ntitle:", "gripper.*with a model"),
        ("title:", "sensors: {middle: sample_rig}\ntitle:", r"sensors\.middle.*left, right"),
        ("title:", "servo: {open: {a: 0}, closed: {a: 1}}\ntitle:", "servo.*without a model"),
        ("title:", "servo: {open: {a: 0}, closed: {b: 1}}\ntitle:", r"servo\.closed.*as open"),
    ],
)
def test_wrong_scene_is_named_by_line_and_key(
    tmp_path: Path, old: str, new: str, found: str
) -> None:
    text = packaged_grasps()["box"].read_text(encoding="utf-8")
    (tmp_path / "box.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(InputError, match=rf"box\.yaml:\d+.*{found}"):
        load_grasp(str(tmp_path / "box.yaml"))


def test_object_too_large_for_the_gripper_is_refused(box: GraspScene) -> None:
    scene = replace(box, gripper=replace(box.gripper, opening=0.02))
    with pytest.raises(ContactError, match=r"left fingertip: cuboid: found"):
        Grasp(scene, pictures=False)


def test_without_mujoco_the_line_that_installs_it_is_said(
    box: GraspScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(InputError, match="pip install mujoco"):
        world.load_mujoco()


def test_shake_ends_where_it_began(box: GraspScene) -> None:
    """A phase that ends within a swing: the hand goes back, and shakes again from there."""
    shake = GraspPhase(name="shake", duration=0.55, shake=0.004, shake_hz=1.0)
    again = replace(shake, name="again", duration=0.1)
    asked = list(motion_of(replace(box, motion=(shake, HOLD, again)), played(box, []).world))
    places = np.array([item.controls.get("shake", 0.0) for item in asked])
    ends = [item.phase.name for item in asked].index("again") - 1
    assert places[ends] == pytest.approx(0.0, abs=1e-9)
    # 4 mm at 1 Hz move by 13 um in a step of half a millisecond.
    assert np.abs(np.diff(places)).max() < 2e-5


def test_two_grasps_do_not_mix(box: GraspScene) -> None:
    """What MuJoCo finds wrong ends the grasp that it is in, and a reset begins it again."""
    wrong, right = (played(box, [CLOSE]) for _ in range(2))
    begin = wrong.world.model.actuator_forcerange.copy()
    nothing = {}, np.zeros(6), 0.15
    wrong.world.data.qvel[:] = 1e14
    right.world.step(*nothing)
    with pytest.raises(ContactError, match=r"MuJoCo: .*QVEL"):
        wrong.world.step(*nothing)
    right.world.step({"grip": -1.0}, np.zeros(6), 0.15)
    for grasp in (wrong, right):
        grasp.restart()
        grasp.world.step(*nothing)
        np.testing.assert_array_equal(grasp.world.model.actuator_forcerange, begin)


def test_world_that_flies_apart_ends_with_a_line(
    box: GraspScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ContactError, match=r"box: 0\.\d+ s, push: MuJoCo"):
        list(played(box, [GraspPhase(name="push", duration=0.1, force=(0, 0, 1e14))]).frames())
    assert not list(tmp_path.iterdir())
