"""Gels and a held object that move: poses of tf, and two fingers of one bag."""

import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.recordings.library import required_sensors
from cmp_tactile_driver.bags.storage import BagStorage
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.ros.messages.definitions import (
    bag_messages,
    simulation_definition,
    simulation_typestore,
)
from cmp_tactile_processing.ros.messages.making import MARKER, MARKER_TOPIC
from cmp_tactile_viewer.moving_scene import TF_MESSAGE, MovingScene
from cmp_tactile_viewer.recording import COMPRESSED_IMAGE, open_source
from cmp_tactile_viewer.snapshot import Snapshot

MAKE = bag_messages()
SIDES = ("left", "right")
FRAMES = 3
LATE = 2  # frames that the right camera begins later
TRIANGLE = np.array([[[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0]]])
QUARTER = Rotation.from_euler("z", 90, degrees=True)


def transforms(stamp_ns, *items):
    """A TFMessage of (parent, child, place) and, where given, a rotation."""
    made = [
        MAKE.transform(
            MAKE.header(stamp_ns, parent), child, np.array(place), *(turn or [Rotation.identity()])
        )
        for parent, child, place, *turn in items
    ]
    return MAKE.new(TF_MESSAGE, transforms=made)


def marker():
    return MAKE.triangles(TRIANGLE, (1, 2, 3), MAKE.header(0, "object"))


@pytest.fixture
def left(sensor):
    return replace(sensor, name="left")


def mount_at(scene, sensor, stamp_ns):
    return scene.placed(Snapshot(stamp_ns), sensor).mount


def test_a_gel_on_a_finger_of_a_gripper_is_where_the_tree_says(left):
    scene = MovingScene("world")
    scene.take_transforms(
        transforms(
            5,
            ("world", "gripper", (0.0, 0.0, 0.1), QUARTER),
            ("gripper", "finger", (0.02, 0.0, 0.0)),
            ("/finger", "left_gel_frame", (0.0, 0.0, 0.01)),
            ("world", "object", (0.0, 0.03, 0.0)),
        )
    )
    scene.take_marker(marker())
    found = scene.placed(Snapshot(5), left)
    assert found.mount.position == pytest.approx((0.0, 0.02, 0.11))
    half = math.sqrt(0.5)
    assert found.mount.orientation == pytest.approx((half, 0.0, 0.0, half))
    assert found.body.pose.position == pytest.approx((0.0, 0.03, 0.0))
    np.testing.assert_array_equal(found.body.triangles, TRIANGLE)
    # As the gripper sees it: the object stands beside it.
    scene.frame = "gripper"
    assert scene.placed(Snapshot(5), left).body.pose.position == pytest.approx((0.03, 0.0, -0.1))


def test_poses_are_those_of_the_moment(left):
    scene = MovingScene("world")
    for stamp, height in ((10, 0.1), (20, 0.2), (30, 0.3)):
        scene.take_transforms(transforms(stamp, ("world", "left_gel_frame", (0, 0, height))))
    heights = [mount_at(scene, left, moment).position[2] for moment in (0, 10, 29, 99)]
    assert heights == [0.1, 0.1, 0.2, 0.3]


def test_what_begins_again_moves_again(left):
    """A live scene keeps the newest transforms only; a clock that is set back starts it again."""
    scene = MovingScene("world", 2)
    for stamp, height in ((10, 0.1), (20, 0.2), (30, 0.3), (5, 0.5)):
        scene.take_transforms(transforms(stamp, ("world", "left_gel_frame", (0, 0, height))))
    assert mount_at(scene, left, 99).position[2] == 0.5


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_what_is_no_pose_is_left_out(left, wrong):
    scene = MovingScene("world")
    good = ("world", "left_gel_frame", (0.0, 0.0, 0.1))
    scene.take_transforms(transforms(1, good))
    scene.take_transforms(transforms(2, ("world", "left_gel_frame", (0.0, wrong, 0.0))))
    zero = transforms(3, good)
    zero.transforms[0].transform.rotation.w = 0.0
    scene.take_transforms(zero)
    assert mount_at(scene, left, 9).position == (0.0, 0.0, 0.1)
    damaged = marker()
    damaged.points[0].x = wrong
    scene.take_marker(damaged)
    scene.take_transforms(transforms(1, ("world", "object", (0.0, 0.0, 0.0))))
    assert scene.placed(Snapshot(9), left).body is None


def test_without_a_common_root_all_stands_still(left, sensor):
    right = replace(sensor, name="right")
    apart = [("table", "left_gel_frame", (0, 0, 0)), ("lab", "right_gel_frame", (0, 0, 0))]
    circle = [("b", "left_gel_frame", (0, 0, 0)), ("left_gel_frame", "b", (0, 0, 0))]
    for items in (apart, circle, []):
        scene = MovingScene()
        scene.take_transforms(transforms(1, *items))
        scene.take_marker(marker())
        scene.find_frame([left, right])
        found = scene.placed(Snapshot(1), left)
        assert (found.mount, found.body) == (None, None)


class FingerBag:
    """Frames of the packaged grasp on two topics, and what is said of the fingers' poses."""

    def __init__(self, folder, grasp_bag):
        self._writer, self._grasp = BagWriter(folder), grasp_bag

    def __enter__(self):
        storage = BagStorage(self._grasp)
        topic = next(name for name, kind in storage.topics.items() if kind == COMPRESSED_IMAGE)
        self.frames = list(storage.messages([topic]))[: FRAMES + LATE]
        self._writer.__enter__()
        for side in SIDES:
            self._writer.add_topic(f"/{side}/image_raw/compressed", COMPRESSED_IMAGE)
        for side, first in zip(SIDES, (0, LATE), strict=True):
            for stored in self.frames[first : first + FRAMES]:
                self._writer.write(f"/{side}/image_raw/compressed", stored.time_ns, stored.data)
        return self

    def __exit__(self, *error):
        self._writer.__exit__(*error)

    def write(self, topic, kind, message, stamp_ns):
        self._writer.add_topic(topic, kind, definition=simulation_definition(kind))
        data = bytes(simulation_typestore().serialize_cdr(message, kind))
        self._writer.write(topic, stamp_ns, data)


@pytest.fixture
def fingers(sensor):
    return [replace(sensor, name=side) for side in SIDES]


def test_both_fingers_and_the_object_move_as_tf_says(grasp_bag, fingers, tmp_path):
    with FingerBag(tmp_path / "bag", grasp_bag) as bag:
        for number, stored in enumerate(bag.frames):
            at = 0.01 * number
            message = transforms(
                stored.stamp_ns,
                ("world", "object", (0.0, 0.0, at)),
                ("world", "left_gel_frame", (0.0, -at, 0.0)),
                ("world", "right_gel_frame", (0.0, at if number < 4 else math.nan, 0.0)),
            )
            bag.write("/tf", TF_MESSAGE, message, stored.time_ns)
        bag.write(MARKER_TOPIC, MARKER, marker(), bag.frames[0].time_ns)
    with closing(open_source(tmp_path / "bag", *fingers)) as source:
        assert [sensor.name for sensor in source.sensors] == [*SIDES]
        moments = list(source.frames.read(0.0))
        # The third frame of the left one is the first of the right one.
        assert [[*moment] for _, moment in moments] == [["left"]] * 2 + [[*SIDES]] + [["right"]] * 2
        period = moments[1][0]
        times = [time_s for time_s, _ in moments]
        assert times == pytest.approx([period * number for number in range(5)], abs=1e-3)
        assert source.playback.length_s == pytest.approx(times[-1], abs=1e-3)
        placed = [
            {name: source.scene.placed(name, shown) for name, shown in moment.items()}
            for _, moment in moments
        ]
        for number, moment in enumerate(placed):
            for name, shown in moment.items():
                assert shown.surface is not None
                assert shown.body.pose.position == pytest.approx((0.0, 0.0, 0.01 * number))
                np.testing.assert_array_equal(shown.body.triangles, TRIANGLE)
                # That of the last is not finite: the one before it stays.
                y = -0.01 * number if name == "left" else 0.01 * min(number, 3)
                assert shown.mount.position == pytest.approx((0.0, y, 0.0))
        again = [[*moment] for _, moment in source.frames.read(3 * period - 1e-3)]
        assert again == [["right"]] * 2


def test_fingers_of_a_bag_without_tf_stand_side_by_side(grasp_bag, fingers, tmp_path):
    with FingerBag(tmp_path / "bag", grasp_bag) as bag:
        bag.write("/tf", TF_MESSAGE, transforms(1), bag.frames[0].time_ns)
    with closing(open_source(tmp_path / "bag", *fingers)) as source:
        _, moment = next(source.frames.read(0.0))
        shown = source.scene.placed("left", moment["left"])
        assert (shown.mount, shown.body) == (None, None)
        left, right = (sensor.mount.position for sensor in source.sensors)
        assert right[0] - left[0] > fingers[0].elastomer.size[0]
        assert right[1:] == left[1:]


def test_sensors_without_topics_of_their_own_are_refused(grasp_bag, fingers, sensor, tmp_path):
    with FingerBag(tmp_path / "bag", grasp_bag):
        pass
    for wrong in ([*fingers, sensor], [fingers[0], fingers[0]]):
        with pytest.raises(FrameSourceError, match=r"different names.*namespaces: left, right"):
            open_source(tmp_path / "bag", *wrong)
    with pytest.raises(FrameSourceError, match="namespaces: none"):
        open_source(tmp_path, *fingers)


def test_a_bag_names_its_sensors_by_files_beside_it(grasp_bag, tmp_path):
    folder = tmp_path / "bag"
    with FingerBag(folder, grasp_bag):
        pass
    with pytest.raises(FrameSourceError, match="found no --sensor"):
        required_sensors(folder)
    for name in (*SIDES, "scene"):
        (folder / f"{name}.yaml").write_bytes((grasp_bag / "sensor.yaml").read_bytes())
    assert required_sensors(folder) == [str(folder / f"{side}.yaml") for side in SIDES]
    (folder / "left.yaml").rename(folder / "sensor.yaml")
    assert required_sensors(folder) == [str(folder / "sensor.yaml")]
