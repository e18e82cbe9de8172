"""Frames, bags and a ROS graph for the tests of the driver."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

FIRST_STAMP_NS = 1_700_000_000 * 10**9
FRAME_NS = 50_000_000
STORE = get_typestore(Stores.ROS2_JAZZY)
_numbers = itertools.count()


def make_frames(count: int, height: int = 48, width: int = 64) -> list[NDArray[np.uint8]]:
    """Frames of noise, so that no two are alike."""
    generator = np.random.default_rng(7)
    return [generator.integers(0, 256, (height, width), np.uint8) for _ in range(count)]


@pytest.fixture
def frames() -> list[NDArray[np.uint8]]:
    return make_frames(12)


@pytest.fixture
def image_folder(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as 0.png, 1.png, ..., 11.png."""
    folder = tmp_path / "images"
    folder.mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number}.png"), frame)
    return folder


def _header(stamp_ns: int) -> Any:
    stamp = STORE.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="rig_camera_optical_frame")


def image_message(frame: NDArray[np.uint8], stamp_ns: int, **changes: Any) -> Any:
    """A sensor_msgs/Image of rosbags; mono8 or bgr8 unless told otherwise."""
    fields = {
        "header": _header(stamp_ns),
        "height": frame.shape[0],
        "width": frame.shape[1],
        "encoding": "mono8" if frame.ndim == 2 else "bgr8",
        "is_bigendian": 0,
        "step": frame[0].nbytes,
        "data": frame.ravel(),
    }
    return STORE.types["sensor_msgs/msg/Image"](**{**fields, **changes})


def compressed_message(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """The frame as PNG in a sensor_msgs/CompressedImage."""
    return STORE.types["sensor_msgs/msg/CompressedImage"](
        header=_header(stamp_ns),
        format="mono8; png compressed ",
        data=cv2.imencode(".png", frame)[1].ravel(),
    )


def camera_info_message(frame: NDArray[np.uint8], stamp_ns: int) -> Any:
    """A calibration that no sensor description has."""
    roi = STORE.types["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, do_rectify=True)
    return STORE.types["sensor_msgs/msg/CameraInfo"](
        header=_header(stamp_ns),
        height=frame.shape[0],
        width=frame.shape[1],
        distortion_model="plumb_bob",
        d=np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
        k=np.arange(9.0),
        r=np.eye(3).ravel(),
        p=np.arange(12.0),
        binning_x=2,
        binning_y=2,
        roi=roi,
    )


def write_bag(
    path: Path, topics: dict[str, Sequence[Any]], storage: StoragePlugin = StoragePlugin.MCAP
) -> Path:
    """A bag of messages by topic; message k is recorded at its stamp, or at k frame times."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        connections = {
            topic: writer.add_connection(topic, messages[0].__msgtype__, typestore=STORE)
            for topic, messages in topics.items()
        }
        rows = []
        for order, (topic, messages) in enumerate(topics.items()):
            for number, message in enumerate(messages):
                rows.append((FIRST_STAMP_NS + number * FRAME_NS, order, topic, message))
        for time_ns, _, topic, message in sorted(rows, key=lambda row: row[:2]):
            connection = connections[topic]
            data = STORE.serialize_cdr(message, connection.msgtype)
            writer.write(connection, time_ns, data)
    return path


def stamps(count: int) -> list[int]:
    """The stamps of the frames of `frame_bag`."""
    return [FIRST_STAMP_NS + number * FRAME_NS for number in range(count)]


class Bags:
    """What the tests need to make bags."""

    image = staticmethod(image_message)
    compressed = staticmethod(compressed_message)
    camera_info = staticmethod(camera_info_message)
    write = staticmethod(write_bag)
    stamps = staticmethod(stamps)
    frames = staticmethod(make_frames)


@pytest.fixture
def bags() -> type[Bags]:
    return Bags


@pytest.fixture
def frame_bag(tmp_path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    """The frames as raw images, with camera infos, at 20 Hz."""
    times = stamps(len(frames))
    return write_bag(
        tmp_path / "bag",
        {
            "/rig/camera_info": [
                camera_info_message(f, t) for f, t in zip(frames, times, strict=True)
            ],
            "/rig/image_raw": [image_message(f, t) for f, t in zip(frames, times, strict=True)],
        },
    )


class RosGraph:
    """Nodes under test and one of the test, in a context and a namespace of their own."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        self.context.init(args=[])
        self.namespace = f"/driver_test_{os.getpid()}_{next(_numbers)}"
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Any] = []
        self.node = self._add(
            rclpy.create_node("tester", context=self.context, namespace=self.namespace)
        )

    def _add(self, node: Any) -> Any:
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def start(self, node_class: Callable[..., Any], **parameters: Any) -> Any:
        """A node under test."""
        from rclpy.parameter import Parameter

        return self._add(
            node_class(
                context=self.context,
                namespace=self.namespace,
                cli_args=[],
                use_global_arguments=False,
                parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()],
            )
        )

    def listen(self, message_type: type, topic: str, **qos: Any) -> list[Any]:
        """The list that messages of the topic are appended to."""
        from rclpy.qos import QoSProfile

        received: list[Any] = []
        profile = QoSProfile(**{"depth": 10, **qos})
        self.node.create_subscription(message_type, topic, received.append, profile)
        return received

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = 20.0) -> None:
        """Run the nodes until the condition holds; the test fails where it never does."""
        end = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end:
                pytest.fail(f"waited {timeout_s:g} s in vain for {what}")
            self.executor.spin_once(timeout_sec=0.02)

    def run(self, duration_s: float) -> None:
        """Run the nodes for a while, to see that something does not happen."""
        end = time.monotonic() + duration_s
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, service_type: Any, name: str, request: Any) -> Any:
        """The answer of a service."""
        client = self.node.create_client(service_type, name)
        self.wait(client.service_is_ready, f"service {name}")
        future = client.call_async(request)
        self.wait(future.done, f"the answer of {name}")
        return future.result()

    def close(self) -> None:
        """Destroy what was made."""
        self.executor.shutdown()
        for node in reversed(self._nodes):
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def ros() -> Iterator[RosGraph]:
    graph = RosGraph()
    yield graph
    graph.close()
