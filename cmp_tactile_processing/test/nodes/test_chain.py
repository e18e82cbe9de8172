"""A recording through the nodes' topics gives the forces that it gives through `Pipeline`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from ros_graph import header_at
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_processing import Pipeline
from cmp_tactile_processing.nodes.force_reconstructor import ForceReconstructor
from cmp_tactile_processing.nodes.gridline_tracker import GridlineTracker
from cmp_tactile_processing.nodes.stereo_triangulator import StereoTriangulator
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import frame_to_msg
from cmp_tactile_processing.ros.wiring import Wiring, joining
from cmp_tactile_processing.sensor.description import SensorDescription, write_sensor_description

pytestmark = pytest.mark.ros

STEP_NS = 50_000_000
# What a zero averages; all are one picture, so that it does not matter which of them are taken.
ZEROED = 10
FLAWED = (4, 6), (12, 10)


def flawed(still: Any) -> np.ndarray:
    """The frame of a gel from whose print the ink at some corners is gone."""
    frame = still.frame.copy()
    for view in ("left", "right"):
        for corner in FLAWED:
            x, y = still.truth[f"corners_{view}_px"][corner]
            cv2.circle(frame, (round(x), round(y)), 5, 175, -1, cv2.LINE_AA)
    return frame


class Container:
    """The nodes of a sensor, connected, which get frames one by one."""

    def __init__(self, ros: Any, description: str, views: Any) -> None:
        self._ros, self.fields, self._sent = ros, [], 0
        wiring = Wiring()
        own = {"sensor_description": description}
        with joining(wiring):
            nodes = [
                ros.start(ForceReconstructor, wait_for_model=True, **own),
                ros.start(StereoTriangulator, auto_reference="never", **own),
                *(
                    ros.start(
                        GridlineTracker,
                        f"{view}_gridline_tracker",
                        view=view,
                        print_frames=ZEROED,
                        **own,
                    )
                    for view in views
                ),
                ros.start(ViewSplitter, **own),
            ]
        with wiring.lock:
            for node in nodes:
                node.attach()
        self.fields = ros.listen(ForceFieldMsg, "force_field")
        ros.wait_subscribed(nodes[0], "force_field")
        self._publisher = ros.publisher(Image, "image_raw")

    def process(self, frame: np.ndarray) -> ForceFieldMsg:
        self._sent += 1
        header = header_at(self._sent * STEP_NS, "rig_camera_optical_frame")
        self._publisher.publish(frame_to_msg(frame, header))
        self._ros.wait(lambda: len(self.fields) == self._sent, f"force {self._sent}", 60)
        return self.fields[-1]

    def set_reference(self, frame: np.ndarray) -> int:
        """Ask for a zero and show the gel at rest until it is taken; how often it was shown."""
        name = f"{self._ros.namespace}/stereo_triangulator/set_reference"
        answer, before = self._ros.call_later(Trigger, name, Trigger.Request()), self._sent
        while not answer.done():
            assert self._sent - before < 200
            self.process(frame)
        assert answer.result().success, answer.result().message
        return self._sent - before


def wrench_of(message: ForceFieldMsg) -> list[float]:
    force, torque = message.wrench.force, message.wrench.torque
    return [force.x, force.y, force.z, torque.x, torque.y, torque.z]


@pytest.mark.parametrize(
    ("follow", "views"), [(False, ("left", "right")), (True, ("left", "right")), (False, ("left",))]
)
def test_nodes_and_pipeline_give_the_same_forces(  # noqa: PLR0917  fixtures
    ros, sensor, stills, tmp_path, follow, views
):
    """Before and after a zero on a flawed print, with presses that are not linear.

    Where a gridline is followed to depends on the frame before, in the seventh digit, and the two
    see the gel at rest as often only in about the same order.
    """
    gel = replace(sensor.elastomer, model="neo_hookean")
    tracking = replace(sensor.tracking, follow=follow)
    if len(views) == 1:
        optics = replace(sensor.optics, type="monocular")
        sensor = replace(sensor, optics=optics, views={"left": sensor.views["left"]})
    description = tmp_path / "sensor.yaml"
    write_sensor_description(description, replace(sensor, elastomer=gel, tracking=tracking))
    container = Container(ros, str(description), views)
    pipeline = Pipeline(SensorDescription.load(description))
    number, seen = 0, []

    def compare(name: str, atol: float = 1e-9) -> None:
        nonlocal number
        number += 1
        frame = flawed(stills[name])
        field, message = pipeline.process(frame, number * STEP_NS).force, container.process(frame)
        np.testing.assert_allclose(wrench_of(message), field.wrench, rtol=0, atol=atol)
        assert message.flags == int(field.flags)
        assert message.corrected == field.corrected
        seen.append(field)

    for name in ("rest", "slide", "press", "rest"):
        compare(name)
    shown = container.set_reference(flawed(stills["rest"]))
    for _ in range(shown):
        number += 1
        pipeline.process(flawed(stills["rest"]), number * STEP_NS)
    pipeline.set_reference([flawed(stills["rest"])] * ZEROED, number * STEP_NS)
    assert all(item.flawed.known.any() for item in pipeline.print_defects.values())
    for name in ("rest", "slide", "press", "twist", "rest"):
        compare(name, 5e-6 if follow else 1e-9)
    assert any(field.corrected for field in seen) == (len(views) == 2)
    assert seen[-1].wrench[2] == pytest.approx(0, abs=0.01)
