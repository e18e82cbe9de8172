"""Frames of a running sensor."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.sources.frames import size_text
from cmp_tactile_processing.errors import CmpTactileError, FrameSourceError
from cmp_tactile_processing.image.encodings import COMPRESSED, BitDepth
from cmp_tactile_processing.ros.messages.conversions import image_from_topic
from cmp_tactile_processing.ros.process import Listener
from cmp_tactile_processing.sensor.description import SensorDescription

IMAGE_TYPES = {Image: IMAGE, CompressedImage: COMPRESSED_IMAGE}
# A camera is faster than a board is found: of what waits, only the newest is worth looking at.
KEPT_FRAMES = 4


class LiveFrames(Listener):
    """Frames of an image topic, received on a thread of its own; a context manager.

    topic: with its namespace; of Images or CompressedImages, or of Images that are published on
    TOPIC/compressed alone.  Frames of another size than the sensor's end the reading.  timeout_s:
    how long to wait for a frame.
    """

    def __init__(self, topic: str, sensor: SensorDescription, timeout_s: float) -> None:
        self._topic = topic if topic.startswith("/") else f"/{topic}"
        self._sensor = sensor
        self._timeout_s = timeout_s
        self._depth = BitDepth(self._topic)
        self._subscription: Any = None
        super().__init__("calibration")
        self._waiting: deque[Image | CompressedImage] = deque(maxlen=KEPT_FRAMES)
        self._arrived = threading.Condition()

    def _subscribe(self) -> None:
        self._look_for_images()

    def _look_for_images(self) -> None:
        """Listen to what is published of the image; nothing as long as nothing is.

        A middleware may refuse a second type of one topic in a process.
        """
        compressed = CompressedImage, self._topic + COMPRESSED
        for kind, topic in (*((kind, self._topic) for kind in IMAGE_TYPES), compressed):
            others = self.node.get_publishers_info_by_topic(topic)
            if any(other.topic_type == IMAGE_TYPES[kind] for other in others):
                self._subscription = self.node.create_subscription(
                    kind, topic, self._on_image, qos_profile_sensor_data
                )
                return

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        """Frames as they come, (H, W) or (H, W, 3) BGR; those that come meanwhile are dropped.

        Raises FrameSourceError where none comes in time, or one that is not the sensor's.
        """
        while True:
            yield self._decoded(self._next())

    def _next(self) -> Image | CompressedImage:
        end = time.monotonic() + self._timeout_s
        with self._arrived:
            while not self._waiting:
                # Short waits, so that Ctrl-C is heard.
                self._arrived.wait(0.1)
                if self._subscription is None:
                    self._look_for_images()
                if not self._waiting and time.monotonic() > end:
                    raise FrameSourceError(self._silence())
            return self._waiting.popleft()

    def _decoded(self, message: Image | CompressedImage) -> NDArray[np.uint8]:
        try:
            image = image_from_topic(message, self._sensor.tracking.grey_weights, self._depth)
        except CmpTactileError as error:
            msg = f"{self._topic}: {error}"
            raise FrameSourceError(msg) from None
        size, expected = (image.shape[1], image.shape[0]), self._sensor.frame_size
        if size != expected:
            found = f"found frames of {size_text(size)}, expected {size_text(expected)}"
            msg = f"{self._topic}: {found}"
            raise FrameSourceError(msg)
        return image

    def _silence(self) -> str:
        """Why nothing came, as far as that can be seen from here."""
        waited = f"{self._topic}: no frame within {self._timeout_s:g} s"
        if self._subscription is not None and self._subscription.get_publisher_count():
            return f"{waited}, although it has a publisher: is the camera running?"
        others = self.node.get_publishers_info_by_topic(self._topic)
        if others:
            kinds = ", ".join(sorted({other.topic_type for other in others}))
            return f"{waited}: found {kinds}, expected {' or '.join(IMAGE_TYPES.values())}"
        images = sorted(
            name
            for name, types in self.node.get_topic_names_and_types()
            if {*types} & {*IMAGE_TYPES.values()} and name != self._topic
        )
        there = f"image topics: {', '.join(images)}" if images else "no image topic exists"
        return f"{waited}: it has no publisher ({there}); is ROS_DOMAIN_ID the same?"

    def _on_image(self, message: Image | CompressedImage) -> None:
        with self._arrived:
            self._waiting.append(message)
            self._arrived.notify_all()
