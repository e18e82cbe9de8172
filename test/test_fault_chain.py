"""Faults through the whole chain, from frame to wrench: one container, and somebody outside."""

import itertools
import pickle
from collections import Counter
from dataclasses import asdict, is_dataclass
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not there")

import cv2
import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from ros_graph import RosGraph, header_at, stamps_of
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray
from waiting import wait_until

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_msgs.msg import Grid, Surface
from cmp_tactile_processing.ros import wiring
from cmp_tactile_processing.ros.messages.conversions import image_to_msg

# Frames at their rate: with other tests beside it, some would be late.
pytestmark = [pytest.mark.ros, pytest.mark.alone]

FRAMES = Path(__file__).parents[1] / "cmp_tactile_processing" / "test" / "data"
PROCESSING = "cmp_tactile_processing"
CHAIN = (
    ("ViewSplitter", "view_splitter", {}),
    ("GridlineTracker", "left_tracker", {"view": "left"}),
    ("GridlineTracker", "right_tracker", {"view": "right"}),
    ("StereoTriangulator", "stereo_triangulator", {}),
    ("ForceReconstructor", "force_reconstructor", {}),
)


def picture(name):
    return cv2.imread(str(FRAMES / f"{name}.png"), cv2.IMREAD_GRAYSCALE)


class Fingers(RosGraph):
    """Sensors in one container, and somebody outside who sends frames and listens."""

    def __init__(self):
        super().__init__()
        self._inside = rclpy.Context()
        self._inside.init(args=[])
        self.container = ComponentContainer(self._inside)
        self.ids = {}
        self._stamps = itertools.count(1)
        self._cameras = {}

    def load(self, sensor, plugin, name, **parameters):
        parameters.setdefault("sensor_description", "sample_rig")
        package = parameters.pop("package", PROCESSING)
        self.ids[f"{sensor}/{name}"] = self.container.load(
            Component(
                package,
                f"{package}::{plugin}",
                name,
                f"{self.namespace}/{sensor}",
                parameters=parameters,
            )
        )

    def load_chain(self, sensor):
        for plugin, name, parameters in CHAIN:
            self.load(sensor, plugin, name, **parameters)
        self._cameras[sensor] = self.node.create_publisher(Image, f"{sensor}/image_raw", 100)
        self.wait(self._cameras[sensor].get_subscription_count, "the splitter")

    def unload(self, name):
        self.container.unload(self.ids.pop(name))

    def send(self, sensor, image, stamp=None):
        """Send a frame; its stamp in ns, a later one than all before unless it is given."""
        stamp = next(self._stamps) * 10_000_000 if stamp is None else stamp
        self._cameras[sensor].publish(image_to_msg(image, "mono8", header_at(stamp)))
        return stamp

    def publish(self, sensor, message):
        self._cameras[sensor].publish(message)

    def listen(self, kind, topic, *, latched=False):
        received = super().listen(kind, topic, latched=latched, depth=1000)
        self.wait(lambda: self.node.count_publishers(topic), f"a publisher of {topic}")
        self.run(0.2)
        return received

    def close(self):
        self.container.shutdown()
        super().close()
        self._inside.try_shutdown()


@pytest.fixture(scope="module")
def fingers():
    """Two fingers with built force models; of the chains of one description."""
    fingers = Fingers()
    for sensor in ("left", "right"):
        fingers.load_chain(sensor)
        wrenches = fingers.listen(WrenchStamped, f"{sensor}/wrench")

        def sent(sensor=sensor):
            fingers.send(sensor, picture("rest"))
            fingers.run(0.2)

        wait_until(lambda wrenches=wrenches: wrenches, "a wrench", step=sent)
    fingers.run(1.0)
    yield fingers
    fingers.close()


def test_sensors_of_one_container_do_not_mix(fingers):
    pictures = {"left": picture("press"), "right": picture("slide")}
    wrenches = {name: fingers.listen(WrenchStamped, f"{name}/wrench") for name in pictures}
    surfaces = {name: fingers.listen(Surface, f"{name}/surface") for name in pictures}
    sent = {name: [] for name in pictures}
    for _ in range(8):
        for name, image in pictures.items():
            sent[name].append(fingers.send(name, image))
        fingers.run(0.1)
    for name in pictures:
        both = wrenches[name], surfaces[name]
        fingers.wait(lambda both=both: min(map(len, both)) >= 8, f"what {name} made")
        assert stamps_of(wrenches[name]) == stamps_of(surfaces[name]) == sent[name]
    depths = {
        name: np.nanmin(np.array(surface[-1].displacement).reshape(-1, 3)[:, 2])
        for name, surface in surfaces.items()
    }
    assert abs(depths["left"] - depths["right"]) > 1e-4
    assert {message.header.frame_id for message in surfaces["left"]} != set()


def test_a_burst_of_twenty_frames_gives_twenty_wrenches(fingers):
    wrenches = fingers.listen(WrenchStamped, "left/wrench")
    sent = [fingers.send("left", picture("rest")) for _ in range(20)]
    fingers.wait(lambda: len(wrenches) >= 20, "twenty wrenches")
    assert stamps_of(wrenches) == sent


def test_who_comes_late_gets_what_is_latched_and_the_next_wrench(fingers):
    earlier = fingers.listen(WrenchStamped, "left/wrench")
    fingers.send("left", picture("rest"))
    fingers.wait(lambda: earlier, "the first wrench")
    latched = [
        fingers.listen(Surface, "left/reference", latched=True),
        fingers.listen(CameraInfo, "left/left/camera_info", latched=True),
        fingers.listen(CameraInfo, "left/right/camera_info", latched=True),
    ]
    transforms = fingers.listen(TFMessage, "/tf_static", latched=True)
    wrenches = fingers.listen(WrenchStamped, "left/wrench")
    fingers.wait(lambda: all(latched) and len(transforms) >= 2, "what is latched")
    fingers.run(0.3)
    assert [len(infos) for infos in latched[1:]] == [1, 1]
    assert len(latched[0]) == 1
    assert wrenches == []
    sent = fingers.send("left", picture("rest"))
    fingers.wait(lambda: wrenches, "the next wrench")
    assert stamps_of(wrenches) == [sent]


@pytest.mark.parametrize(
    "names", [("view_splitter",), ("stereo_triangulator", "right_tracker")], ids=" and ".join
)
def test_a_component_that_is_unloaded_and_loaded_again_rejoins(fingers, names):
    grids, surfaces = (
        fingers.listen(kind, f"right/{topic}")
        for kind, topic in ((Grid, "left/grid"), (Surface, "surface"))
    )
    made = {name: (plugin, parameters) for plugin, name, parameters in CHAIN}
    fingers.send("right", picture("rest"))
    fingers.wait(lambda: surfaces and grids, "surfaces before")
    for name in names:
        fingers.unload(f"right/{name}")
        fingers.send("right", picture("rest"))
    for name in names:
        plugin, parameters = made[name]
        fingers.load("right", plugin, name, **parameters)
        fingers.send("right", picture("rest"))
    fingers.wait(lambda: fingers._cameras["right"].get_subscription_count() == 1, "the splitter")

    def joined():
        stamp = fingers.send("right", picture("rest"))
        fingers.run(0.3)
        return stamp in stamps_of(surfaces) and stamp in stamps_of(grids)

    fingers.wait(joined, "a frame that passes all of them")
    sent = []
    for _ in range(10):
        sent.append(fingers.send("right", picture("rest")))
        fingers.run(0.05)
    fingers.wait(lambda: stamps_of(surfaces)[-1] == sent[-1], "surfaces afterwards")
    assert stamps_of(surfaces)[-10:] == sent
    for messages in (grids, surfaces):
        assert max(Counter(stamps_of(messages)).values()) == 1


def test_no_node_changes_what_another_gave_away(fingers, monkeypatch):
    """Nodes of a container share objects; clouds, overlays and markers are made from them, too."""
    given = []
    publish = wiring.Output.publish

    def content(value):
        # Without what the value computes at its first use.
        return pickle.dumps(asdict(value) if is_dataclass(value) else value)

    def watched(output, value, header):
        given.append((value, content(value)))
        publish(output, value, header)

    monkeypatch.setattr(wiring.Output, "publish", watched)
    fingers.load("left", "SurfaceVisualizer", "surface_visualizer")
    topics = (
        (Image, "left/image_rect"),
        (Image, "left/grid_overlay"),
        (PointCloud2, "surface_points"),
        (PointCloud2, "force_points"),
        (MarkerArray, "markers"),
    )
    heard = [fingers.listen(kind, f"left/{topic}") for kind, topic in topics]
    for name in ("rest", "press", "slide", "press", "rest"):
        fingers.send("left", picture(name))
        fingers.run(0.3)
    fingers.wait(lambda: all(heard), "all that can be made")
    fingers.unload("left/surface_visualizer")
    assert {type(value).__name__ for value, _ in given} >= {"Grid", "Surface", "ForceField"}
    assert [type(value) for value, before in given if content(value) != before] == []
