"""Throttled topics have the first frame of each period, and the same frames at every stage."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import Surface
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import image_to_msg, surface_to_msg
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_processing.ros.throttle import ResultPublisher
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

pytestmark = pytest.mark.ros

MS = 1_000_000
SENSOR = load_sensor("sample_rig")
SURFACE = surface_at_rest(Reference.nominal(SENSOR), SENSOR.pattern.shape)
# Two frames lie in the same tenth of a second, and three in the same thirtieth.
STAMPS_MS = (0, 16, 33, 50, 67, 83, 100, 117, 210, 5, 20)
IMAGES_MS = [0, 100, 210, 5]
SURFACES_MS = [0, 50, 67, 100, 210, 5]


def _header(milliseconds: int) -> Header:
    header = Header(frame_id="camera")
    header.stamp.sec, header.stamp.nanosec = 7, milliseconds * MS
    return header


def _milliseconds(messages: list) -> list[int]:
    return [stamp_ns(message.header.stamp) // MS - 7000 for message in messages]


def test_images_are_those_of_the_frames_that_are_split(ros):
    node = ros.start(ViewSplitter)
    few = ros.listen(Image, "image_raw_throttle")
    views = ros.listen(Image, "left/image_raw")
    ros.wait_subscribed(node, "image_raw_throttle", "left/image_raw")
    publisher = ros.publisher(Image, "image_raw")
    size = SENSOR.image.height, SENSOR.image.width
    for number, stamp in enumerate(STAMPS_MS):
        publisher.publish(image_to_msg(np.full(size, number, np.uint8), "mono8", _header(stamp)))
        ros.wait(lambda count=number + 1: len(views) == count, "the views of a frame")
    ros.wait(lambda: len(few) == len(IMAGES_MS), "the images")
    assert _milliseconds(few) == IMAGES_MS
    assert [message.data[0] for message in few] == [STAMPS_MS.index(ms) for ms in IMAGES_MS]
    assert few[0].header.frame_id == "camera"


def test_results_are_made_once_for_both_topics_and_only_for_who_listens(ros):
    node = ros.start(ViewSplitter)
    made = []

    def to_msg(value, header):
        made.append(stamp_ns(header.stamp) // MS - 7000)
        return surface_to_msg(value, header)

    results = ResultPublisher(node, Surface, "surface", to_msg)
    results.publish(SURFACE, _header(900))
    assert made == []
    few = ros.listen(Surface, "surface_throttle")
    ros.wait_subscribed(node, "surface_throttle")
    for stamp in STAMPS_MS:
        results.publish(SURFACE, _header(stamp))
    ros.wait(lambda: len(few) == len(SURFACES_MS), "the surfaces")
    assert _milliseconds(few) == SURFACES_MS == made
    every = ros.listen(Surface, "surface")
    ros.wait_subscribed(node, "surface")
    made.clear()
    results.publish(SURFACE, _header(300))
    ros.wait(lambda: every and len(few) > len(SURFACES_MS), "both")
    assert made == [300]
