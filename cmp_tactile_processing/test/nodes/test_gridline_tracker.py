"""Views go in over DDS; grids and overlays come out.  Of the grids: test_chain.py."""

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

CHANNELS = ("red", "green", "blue")


def _stamp(number: int) -> Time:
    return Time(sec=100 + number, nanosec=7 * number)


def _view(sample) -> np.ndarray:
    return np.ascontiguousarray(sample("rest").frame[:, 511::-1])


def _message(image: np.ndarray, number: int) -> Image:
    encoding = "mono8" if image.ndim == 2 else "bgr8"
    return image_to_msg(image, encoding, Header(stamp=_stamp(number)))


def test_overlay_is_drawn_for_subscribers_only_and_where_the_corners_are(ros, sample, count_calls):
    drawn = count_calls(gridline_tracker_node, "draw_grid")
    tracker = ros.start(GridlineTracker)
    grids = ros.listen(GridMsg, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    publisher.publish(_message(_view(sample), 0))
    ros.wait(lambda: grids, "a grid")
    assert not drawn
    overlays = ros.listen(Image, "left/grid_overlay")
    ros.wait_subscribed(tracker, "left/grid_overlay")
    publisher.publish(_message(_view(sample), 1))
    ros.wait(lambda: overlays, "the overlay")
    (overlay,) = overlays
    assert overlay.header.stamp == _stamp(1)
    assert (overlay.encoding, overlay.width, overlay.height) == ("bgr8", 512, 768)
    image = np.frombuffer(overlay.data, np.uint8).reshape(768, 512, 3).astype(int)
    corners = np.reshape(grids[0].corner_px, (-1, 2)).round().astype(int)
    blue, green, red = image[corners[:, 1], corners[:, 0]].T
    assert (green > red + 50).all()
    assert (green > blue + 50).all()
    grey = image[:20, :20]
    assert (grey == grey[..., :1]).all(), "outside the grid the view shows as it is"


def test_an_image_without_a_pattern_gives_a_missing_grid_with_its_fault(ros, sample):
    tracker = ros.start(GridlineTracker)
    grids = ros.listen(GridMsg, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    publisher.publish(_message(np.zeros((768, 512), np.uint8), 0))
    publisher.publish(_message(_view(sample), 1))
    ros.wait(lambda: len(grids) == 2, "a grid for each")
    lost, good = grids
    assert lost.header.stamp == _stamp(0)
    assert lost.fault == "dark"
    assert lost.reason
    assert np.isnan(lost.corner_px).all()
    assert not any(lost.corner_status)
    assert (lost.found_fraction, lost.confidence, lost.followed) == (0.0, 0.0, False)
    assert (good.found_fraction, good.fault, good.reason) == (1.0, "", "")
    assert tracker.diagnostics.bad_frames == 0


def test_the_projection_of_colours_is_set_while_it_runs(ros, sample):
    """Red and green of equal luminance: grey sees nothing, red against green everything."""
    ros.start(GridlineTracker)
    grids = ros.listen(GridMsg, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    share = np.clip((_view(sample) - 15.0) / 190, 0, 1)
    colours = np.stack([0 * share, 200 * 0.299 / 0.587 * (1 - share), 200 * share], axis=-1)
    image = np.rint(colours).astype(np.uint8)
    publisher.publish(_message(image, 0))
    ros.wait(lambda: len(grids) == 1, "a grid")
    assert (grids[0].found_fraction, grids[0].fault) == (0.0, "no_contrast")
    refused = ros.set_parameters("gridline_tracker", dict.fromkeys(CHANNELS, 0.0), together=True)
    assert not refused.successful
    assert refused.reason.startswith("tracking.red, tracking.green, tracking.blue: found 0, 0, 0")
    weights = dict(zip(CHANNELS, (0.5, -0.5, 0.0), strict=True))
    assert ros.set_parameters("gridline_tracker", weights, together=True).successful
    publisher.publish(_message(image, 1))
    ros.wait(lambda: len(grids) == 2, "a grid")
    assert grids[1].found_fraction == 1.0


def test_a_burst_is_drawn_as_its_first_and_its_last_image(ros, sample, count_calls):
    """The overlay costs the tracker little, and the last one is never left out."""
    burst = 8
    drawn = count_calls(gridline_tracker_node, "draw_grid")
    tracker = ros.start(GridlineTracker, overlay_rate=1.0)
    grids, overlays = ros.listen(GridMsg, "left/grid"), ros.listen(Image, "left/grid_overlay")
    ros.wait_subscribed(tracker, "left/grid_overlay")
    publisher = ros.publisher(Image, "left/image_raw")

    def send(first: int) -> None:
        for number in range(first, first + burst):
            publisher.publish(_message(_view(sample), number))
        ros.wait(lambda: len(grids) == first + burst, "a grid of every image")

    send(0)
    ros.wait(lambda: len(overlays) == 2, "two overlays")
    assert len(drawn) == 2
    assert [overlay.header.stamp for overlay in overlays] == [_stamp(0), _stamp(burst - 1)]
    tracker.set_parameters([Parameter("overlay_rate", value=0.0)])
    send(burst)
    ros.wait(lambda: len(overlays) == 2 + burst, "an overlay of every image")
