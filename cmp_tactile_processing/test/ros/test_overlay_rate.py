"""The overlay costs the tracker little: drawn at a limited rate, and never is the last left out."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_processing.nodes import gridline_tracker as gridline_tracker_node
from cmp_tactile_processing.nodes.gridline_tracker import GridlineTracker
from cmp_tactile_processing.ros.messages.conversions import image_to_msg

pytestmark = pytest.mark.ros

BURST = 8


def test_a_burst_is_drawn_as_its_first_and_its_last_image(ros, sample, count_calls):
    drawn = count_calls(gridline_tracker_node, "draw_grid")
    tracker = ros.start(GridlineTracker, overlay_rate=1.0)
    grids, overlays = ros.listen(GridMsg, "left/grid"), ros.listen(Image, "left/grid_overlay")
    ros.wait_subscribed(tracker, "left/grid_overlay")
    publisher = ros.publisher(Image, "left/image_raw")
    view = np.ascontiguousarray(sample("rest").frame[:, 511::-1])

    def send(first: int) -> None:
        for number in range(first, first + BURST):
            publisher.publish(image_to_msg(view, "mono8", Header(stamp=Time(sec=number))))
        ros.wait(lambda: len(grids) == first - 1 + BURST, "a grid of every image")

    send(1)
    ros.wait(lambda: len(overlays) == 2, "two overlays")
    assert len(drawn) == 2
    assert [overlay.header.stamp.sec for overlay in overlays] == [1, BURST]
    tracker.set_parameters([Parameter("overlay_rate", value=0.0)])
    send(BURST + 1)
    ros.wait(lambda: len(overlays) == 2 + BURST, "an overlay of every image")
