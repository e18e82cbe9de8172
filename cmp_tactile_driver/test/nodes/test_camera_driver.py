"""The node camera_driver: lifecycle, frames and diagnostics over real topics."""

import gc
import importlib
import sys

import cv2
import made_bags
import numpy as np
import pytest
from ros_graph import stamps_of

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from sensor_msgs.msg import CameraInfo, Image

from cmp_tactile_driver.nodes.camera_driver import CameraDriver
from cmp_tactile_processing.errors import InputError

NODE = "camera_driver"


@pytest.fixture
def sensor_folder(tmp_path):
    """Six frames of the sample rig's size, and one that is not."""
    frames = made_bags.frames(6, 768, 1024)
    for number, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / f"{number}.png"), frame)
    cv2.imwrite(str(tmp_path / "9.png"), np.zeros((10, 10), np.uint8))
    return tmp_path, frames


def _start(ros, folder, **parameters):
    given = {"sensor_description": "sample_rig", "frame_rate": 50.0, "input": str(folder)}
    return ros.start(CameraDriver, **{**given, **parameters})


def test_without_an_input_it_does_not_start(ros):
    """It could never be given one: such a node would stay and never publish."""
    message = r"camera_driver: parameter input: found nothing, expected"
    with pytest.raises(InputError, match=message):
        ros.start(CameraDriver, source="simulated")


def test_lifecycle_frames_and_the_end(ros, sensor_folder):
    folder, frames = sensor_folder
    images = ros.listen(Image, "image_raw", depth=100)
    infos = ros.listen(CameraInfo, "camera_info", depth=100)
    reports = ros.reports("camera_driver")
    node = _start(ros, folder, autostart=False)
    assert ros.lifecycle_state(NODE) == "unconfigured"
    assert ros.change_state(NODE, Transition.TRANSITION_CONFIGURE)
    ros.run(0.2)
    assert (ros.lifecycle_state(NODE), images) == ("inactive", [])
    ros.wait(lambda: node.count_subscribers("image_raw") == 1, "the subscriber")
    begin = ros.node.get_clock().now().nanoseconds
    assert ros.change_state(NODE, Transition.TRANSITION_ACTIVATE)
    ros.wait(lambda: len(images) == len(infos) == len(frames), "the frames")
    for image, frame in zip(images, frames, strict=True):
        assert np.array_equal(np.frombuffer(image.data, np.uint8).reshape(768, 1024), frame)
    stamps = stamps_of(images)
    assert begin < stamps[0] < stamps[-1] < ros.node.get_clock().now().nanoseconds
    assert {image.header.frame_id for image in images} == {"sample_rig_camera_optical_frame"}
    assert [info.header.stamp for info in infos] == [image.header.stamp for image in images]
    assert (infos[0].width, infos[0].height) == (1024, 768)
    assert infos[0].distortion_model == "plumb_bob"
    expected = [733.3859777674537, 0, 511.5, 0, 733.3859777674537, 383.5, 0, 0, 1]
    assert list(infos[0].k) == expected
    ros.wait(lambda: "the source has ended" in reports.last.message, "the end in the diagnostics")
    assert reports.last.level == DiagnosticStatus.WARN
    assert (reports.values["frames out"], reports.values["bad frames"]) == ("6", "1")
    assert "9.png: found 10 x 10 px, expected 1024 x 768 px" in reports.values["problem"]
    for transition, state in (
        (Transition.TRANSITION_DEACTIVATE, "inactive"),
        (Transition.TRANSITION_CLEANUP, "unconfigured"),
    ):
        assert ros.change_state(NODE, transition)
        assert ros.lifecycle_state(NODE) == state


def test_a_source_that_is_missing_can_be_configured_later(ros, tmp_path):
    folder = tmp_path / "later"
    reports = ros.reports("camera_driver")
    _start(ros, folder, sensor_name="left_finger")
    assert ros.lifecycle_state(NODE) == "unconfigured"
    ros.wait(lambda: reports.last.level == DiagnosticStatus.ERROR, "an error in the diagnostics")
    assert f"{folder}: found no such file or folder" in reports.last.message
    folder.mkdir()
    cv2.imwrite(str(folder / "0.png"), made_bags.frames(1, 768, 1024)[0])
    images, infos = ros.listen(Image, "image_raw"), ros.listen(CameraInfo, "camera_info")
    assert ros.change_state(NODE, Transition.TRANSITION_CONFIGURE)
    assert ros.change_state(NODE, Transition.TRANSITION_ACTIVATE)
    ros.wait(lambda: images and infos, "a frame")
    for message in (images[0], infos[0]):
        assert message.header.frame_id == "left_finger_camera_optical_frame"


def test_destroyed_node_leaves_the_graph_without_garbage_collection(ros, sensor_folder):
    gc.disable()
    try:
        node = _start(ros, sensor_folder[0], loop=True)
        ros.wait(lambda: "camera_driver" in ros.node.get_node_names(), "the node")
        ros.executor.remove_node(node)
        node.destroy_node()
        ros.wait(lambda: "camera_driver" not in ros.node.get_node_names(), "the node to be gone")
    finally:
        gc.enable()


TAPE = """
import numpy as np
from cmp_tactile_driver.sources.frames import Frame, SourceHealth

class Tape:
    name, frame_rate, health, log = "reel 3", 50.0, SourceHealth(0, "worn"), []

    def __init__(self, options):
        self.log.append("open")

    def read(self):
        return Frame(np.zeros((768, 1024), np.uint8), "here")

    def extend(self, node):
        self.log.append("extend " + node.get_name())
        return self

    def frame_sent(self, frame, header):
        stamp_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
        self.log.append((frame.origin, stamp_ns, header.frame_id))

    @property
    def diagnostics(self):
        return {"reels": 3}

    def close(self):
        self.log.append("close")
"""


@pytest.fixture
def tape_log(install_sources):
    """A source of another package that extends the node; what is called of it."""
    install_sources("tape_source", TAPE, tape="Tape")
    yield importlib.import_module("tape_source").Tape.log
    del sys.modules["tape_source"]


def test_a_source_may_extend_the_node(ros, tape_log):
    images = ros.listen(Image, "image_raw", depth=100)
    reports = ros.reports("camera_driver")
    _start(ros, "reel", source="tape")
    ros.wait(lambda: len(images) > 3, "frames")
    ros.wait(lambda: reports.values.get("reels") == "3", "the source's own diagnostics")
    assert (reports.last.level, reports.last.message) == (DiagnosticStatus.WARN, "worn")
    assert ros.change_state(NODE, Transition.TRANSITION_DEACTIVATE)
    assert ros.change_state(NODE, Transition.TRANSITION_CLEANUP)
    reported = {item for item in tape_log if isinstance(item, tuple)}
    frame_id = "sample_rig_camera_optical_frame"
    assert {("here", stamp_ns, frame_id) for stamp_ns in stamps_of(images)} <= reported
    # The extension is closed, then the source.
    assert [item for item in tape_log if isinstance(item, str)] == [
        "open",
        "extend camera_driver",
        "close",
        "close",
    ]


def test_an_unexpected_error_of_a_source_is_reported(ros, sensor_folder, monkeypatch, capfd):
    """rclpy passes over what a transition raises, without a word."""

    def opens(_options):
        msg = "of a library"
        raise RuntimeError(msg)

    module = "cmp_tactile_driver.sources.frames"
    monkeypatch.setattr(importlib.import_module(module), "find_source", lambda _name: opens)
    reports = ros.reports("camera_driver")
    _start(ros, sensor_folder[0])
    assert ros.lifecycle_state(NODE) == "unconfigured"
    ros.wait(lambda: "RuntimeError: of a library" in reports.last.message, "the report")
    assert reports.last.level == DiagnosticStatus.ERROR
    assert "Traceback" in capfd.readouterr().err
