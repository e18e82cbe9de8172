"""The tracker's service that inspects the print from the next frames."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_processing.nodes.gridline_tracker import GridlineTracker
from cmp_tactile_processing.ros.messages.conversions import image_to_msg
from cmp_tactile_processing.sensor.dot_code import dot_map

pytestmark = pytest.mark.ros


class Rig:
    """A tracker of the left view that gets frames one by one."""

    def __init__(self, ros, **parameters) -> None:
        self.ros = ros
        self.node = ros.start(GridlineTracker, view="left", **parameters)
        self.grids = ros.listen(GridMsg, "left/grid")
        self._publisher = ros.publisher(Image, "left/image_raw")
        self._sent = 0

    def send(self, frame: np.ndarray) -> GridMsg:
        self._sent += 1
        view = np.ascontiguousarray(frame[:, :512][:, ::-1])
        header = Header(stamp=Time(sec=self._sent))
        self._publisher.publish(image_to_msg(view, "mono8", header))
        self.ros.wait(lambda: len(self.grids) == self._sent, f"grid {self._sent}", 60)
        return self.grids[-1]

    def inspect_later(self):
        """Asked for, and the next frames count."""
        name = f"{self.ros.namespace}/gridline_tracker/inspect_print"
        future = self.ros.call_later(Trigger, name, Trigger.Request())
        self.ros.wait(lambda: self.node._inspection.is_open, "the request")
        return future


def spotted(sample) -> tuple[np.ndarray, tuple[int, int]]:
    """The frame at rest with a light spot on corner (10, 10), and that corner."""
    rest = sample("rest")
    frame = rest.frame.copy()
    x, y = rest.truth["corners_left_px"][10, 10]
    cv2.circle(frame, (round(x), round(y)), 5, 175, -1, cv2.LINE_AA)
    return frame, (10, 10)


def test_flaws_are_reported_and_known_again(ros, sample):
    rig = Rig(ros, print_frames=2)
    frame, corner = spotted(sample)
    before = np.array(rig.send(frame).corner_std_px).reshape(20, 20)
    answer = rig.inspect_later()
    rig.send(frame)
    assert not answer.done(), "one of two frames is not enough"
    rig.send(frame)
    ros.wait(answer.done, "the report", 60)
    assert answer.result().success
    assert "1 spot without ink" in answer.result().message
    after = np.array(rig.send(frame).corner_std_px).reshape(20, 20)
    # The spot is where it was: its picture fits, far better than the model of a corner.
    assert after[corner] < before[corner] / 3
    far = np.ones((20, 20), bool)
    far[7:14, 7:14] = False
    np.testing.assert_allclose(after[far], before[far], rtol=0.2)


def test_a_moving_gel_is_not_inspected(ros, sample):
    rig = Rig(ros, print_frames=2)
    answer = rig.inspect_later()
    rig.send(sample("rest").frame)
    rig.send(sample("slide").frame)
    ros.wait(answer.done, "the answer", 60)
    assert not answer.result().success
    assert "the gel must be at rest" in answer.result().message


def test_dots_that_are_not_described_stand_in_the_diagnostics(ros, sample):
    rig, rest = Rig(ros), sample("rest")
    frame, corners = rest.frame.copy(), rest.truth["corners_left_px"]
    middles = (corners[:-1, :-1] + corners[1:, 1:]) / 2
    # Checkers inside of the outermost corners.
    for row, col in np.argwhere(dot_map(*middles.shape[:2])):
        x, y = middles[row, col]
        grey = 45 if frame[round(y), round(x)] > 128 else 205
        cv2.circle(frame, (round(4 * x), round(4 * y)), 6, grey, -1, cv2.LINE_AA, 2)
    reports = ros.listen(DiagnosticArray, "/diagnostics")
    rig.send(frame)

    def is_said():
        return any("pattern.code is none" in item.message for msg in reports for item in msg.status)

    ros.wait(is_said, "the dots", 10)
