"""What the recorder wrote, played as `ros2 bag play --clock` does, serves the nodes as the camera.

`ros2 bag play` publishes the bytes of each message, on its topic, with the QoS in metadata.yaml.
"""

from __future__ import annotations

import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

pytestmark = pytest.mark.ros

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image

from cmp_tactile_driver.nodes.recorder import Recorder
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import message_class

COUNT = 12
# A frame's age by the recorded clock is less than the time the recording may have taken.
RECORDING_MS = 20_000.0


class BagPlay:
    """A publisher for each topic of a bag, and /clock."""

    def __init__(self, node: Any, bag: Path) -> None:
        self._bag = bag
        with Reader(bag) as reader:
            self.publishers = {
                connection.topic: node.create_publisher(
                    message_class(connection.msgtype),
                    connection.topic,
                    QoSProfile(
                        depth=10,
                        reliability=ReliabilityPolicy[qos.reliability.name],
                        durability=DurabilityPolicy[qos.durability.name],
                    ),
                )
                for connection in reader.connections
                for qos in connection.ext.offered_qos_profiles
            }
        self._clock = node.create_publisher(Clock, "/clock", 10)

    def play(self, ros: Any) -> None:
        with Reader(self._bag) as reader:
            for connection, time_ns, data in reader.messages():
                tick = Clock()
                tick.clock.sec, tick.clock.nanosec = divmod(time_ns, 10**9)
                self._clock.publish(tick)
                ros.run(0.02)
                self.publishers[connection.topic].publish(bytes(data))
                ros.run(0.02)


def record(ros: Any, bags: Any, bag: Path, compression: str) -> tuple[list[np.ndarray], list[int]]:
    """Record frames of this moment; those frames, and their stamps."""
    now_ns = ros.node.get_clock().now().nanoseconds
    stamps = [now_ns + number * 10**7 for number in range(COUNT)]
    frames = bags.frames(COUNT, 768, 1024)
    publisher = ros.node.create_publisher(Image, "image_raw", 100)
    node = ros.start(Recorder, output=str(bag), compression=compression, topics="image_raw")
    ros.wait(publisher.get_subscription_count, "the recorder")
    for frame, stamp_ns in zip(frames, stamps, strict=True):
        image = Image(height=768, width=1024, encoding="mono8", step=1024)
        image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        image.data = array.array("B", frame.tobytes())
        publisher.publish(image)
        ros.run(0.01)
    ros.wait(lambda: sum(node.progress.messages.values()) == COUNT, "all frames")
    node.stop()
    ros.node.destroy_publisher(publisher)
    return frames, stamps


@pytest.mark.parametrize(("compression", "transport"), [("zstd", "raw"), ("png", "compressed")])
def test_every_frame_reaches_the_views_twice(ros, bags, tmp_path, compression, transport):
    """The second time clock and stamps go back to the beginning, as with --loop."""
    frames, stamps = record(ros, bags, tmp_path / "bag", compression)
    views = ros.listen(Image, "left/image_raw", depth=100)
    reports = ros.listen(DiagnosticArray, "/diagnostics", depth=100)
    splitter = ros.start(ViewSplitter, use_sim_time=True, input_transport=transport)
    played = BagPlay(ros.node, tmp_path / "bag")
    (publisher,) = played.publishers.values()
    ros.wait(publisher.get_subscription_count, "the splitter")
    for count in (COUNT, 2 * COUNT):
        played.play(ros)
        ros.wait(lambda count=count: len(views) == count, f"{count} views")
    found = [view.header.stamp.sec * 10**9 + view.header.stamp.nanosec for view in views]
    assert found == [*stamps, *stamps]
    for view, frame in zip(views, [*frames, *frames], strict=True):
        image = np.frombuffer(view.data, np.uint8).reshape(768, 512)
        assert np.array_equal(image, frame[:, 511::-1])
    assert splitter.diagnostics.bad_frames == 0
    # By the clock of the recording a frame is as old as it was when it was recorded.
    values = [
        float(item.value)
        for report in reports
        for status in report.status
        if status.name.endswith("view_splitter")
        for item in status.values
        if item.key.startswith("latency") and item.value != "no frames"
    ]
    assert values
    assert max(abs(value) for value in values) < RECORDING_MS
