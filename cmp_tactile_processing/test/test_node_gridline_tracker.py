"""Frames go through splitter and tracker over DDS; the grids are compared with the truth."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Grid as GridMsg
from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.nodes import gridline_tracker_node
from cmp_tactile_processing.nodes.conversions import grid_from_msg
from cmp_tactile_processing.nodes.gridline_tracker_node import GridlineTracker
from cmp_tactile_processing.nodes.images import image_to_msg
from cmp_tactile_processing.nodes.view_splitter_node import ViewSplitter
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.sensor_library import load_sensor

pytestmark = pytest.mark.ros

# What the whole chain promises for clean frames.
RMSE_PX = 0.05


def _stamp(number: int) -> Time:
    return Time(sec=100 + number, nanosec=7 * number)


def _view_msg(sample, view: str = "left", number: int = 0) -> Image:
    half = sample.frame[:, :512] if view == "left" else sample.frame[:, 512:]
    return image_to_msg(np.ascontiguousarray(half[:, ::-1]), "mono8", Header(stamp=_stamp(number)))


def test_both_views_of_three_frames_match_the_truth(ros, sample):
    sensor = load_sensor("sample_rig")
    views = build_views(sensor)
    ros.start(ViewSplitter)
    grids = {}
    for view in ("left", "right"):
        ros.start(GridlineTracker, name=f"{view}_tracker", view=view)
        grids[view] = ros.listen(GridMsg, f"{view}/grid")
    samples = [sample(name) for name in ("rest", "slide", "press")]
    publisher = ros.publisher(Image, "image_raw")
    for view in views:
        ros.wait(lambda v=view: ros.node.count_subscribers(f"{ros.namespace}/{v}/image_raw"), view)
    ros.run(0.2)
    for number, item in enumerate(samples):
        publisher.publish(image_to_msg(item.frame, "mono8", Header(stamp=_stamp(number))))
    ros.wait(lambda: all(len(found) == 3 for found in grids.values()), "three grids a view", 60)
    for view, found in grids.items():
        for number, (msg, item) in enumerate(zip(found, samples, strict=True)):
            assert msg.header == Header(
                stamp=_stamp(number), frame_id=f"sample_rig_{view}_optical_frame"
            )
            assert msg.found_fraction == 1.0
            grid = grid_from_msg(msg, sensor.pattern.shape, views[view].placement)
            error = grid.corners_frame - item.truth[f"corners_{view}_px"]
            assert np.sqrt(np.mean(np.sum(error**2, axis=-1))) <= RMSE_PX


def test_overlay_is_drawn_for_subscribers_only_and_where_the_corners_are(ros, sample, count_calls):
    drawn = count_calls(gridline_tracker_node, "draw_grid")
    tracker = ros.start(GridlineTracker)
    grids = ros.listen(GridMsg, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    publisher.publish(_view_msg(sample("rest"), number=0))
    ros.wait(lambda: grids, "a grid")
    assert not drawn
    overlays = ros.listen(Image, "left/grid_overlay")
    ros.wait_subscribed(tracker, "left/grid_overlay")
    publisher.publish(_view_msg(sample("rest"), number=1))
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


def test_black_image_gives_a_missing_grid_with_its_reason(ros):
    ros.start(GridlineTracker, view="right")
    grids = ros.listen(GridMsg, "right/grid")
    black = np.zeros((768, 512), np.uint8)
    ros.publisher(Image, "right/image_raw").publish(
        image_to_msg(black, "mono8", Header(stamp=_stamp(3)))
    )
    ros.wait(lambda: grids, "a grid")
    (msg,) = grids
    assert np.isnan(msg.corner_px).all()
    assert not any(msg.corner_status)
    assert (msg.found_fraction, msg.header.stamp) == (0.0, _stamp(3))
    assert msg.reason


def test_bad_images_do_not_stop_the_tracker(ros, sample):
    tracker = ros.start(GridlineTracker)
    grids = ros.listen(GridMsg, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    whole = image_to_msg(sample("rest").frame, "mono8", Header(stamp=_stamp(0)))
    empty = Image(encoding="mono8", header=Header(stamp=_stamp(1)))
    for msg in (whole, empty, _view_msg(sample("rest"), number=2)):
        publisher.publish(msg)
    ros.wait(lambda: grids, "the grid of the good image")
    assert grids[0].header.stamp == _stamp(2)
    assert tracker.diagnostics.bad_frames == 2
    assert "width, height: found 0 x 0" in tracker.diagnostics.last_error


def test_unknown_view_is_refused_at_the_start(ros):
    with pytest.raises(ParameterError, match=r"view: found 'top', expected one of left, right"):
        ros.start(GridlineTracker, view="top")


def test_parameters_are_described_and_bad_values_refused_with_the_reason(ros):
    ros.start(GridlineTracker)
    base = f"{ros.namespace}/gridline_tracker"
    request = DescribeParameters.Request(names=["detector", "view", "sensor_description"])
    detector, view, description = ros.call(
        DescribeParameters, f"{base}/describe_parameters", request
    ).descriptors
    assert detector.description
    assert "contour_stitching" in detector.additional_constraints
    assert not detector.read_only
    assert view.read_only
    assert description.read_only
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="guessing")
    request = SetParameters.Request(parameters=[ParameterMsg(name="detector", value=value)])
    (result,) = ros.call(SetParameters, f"{base}/set_parameters", request).results
    assert not result.successful
    assert "detector: found 'guessing', expected one of" in result.reason
