"""Camera frames from a ROS topic, as a calibration takes them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import ImageSize, size_text
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.geometry.split import LUMINANCE
from cmp_tactile_processing.ros.messages.images import image_from_msg
from cmp_tactile_processing.ros.process import Listener

__all__ = ["LiveFrames"]

IMAGE_TYPE = "sensor_msgs/msg/Image"
# A camera is faster than a board is found: of what waits, only the newest is worth looking at.
KEPT_FRAMES = 4


class LiveFrames(Listener):
    """Frames of an image topic, received on a thread of its own; a context manager.

    topic: with its namespace.  expected_size: frames of another size end the reading; None takes
    the size of the first.  timeout_s: how long to wait for a frame.
    """

    def __init__(
        self,
        topic: str,
        expected_size: ImageSize | None = None,
        timeout_s: float = 10.0,
        grey_weights: tuple[float, float, float] = LUMINANCE,
    ) -> None:
        self._topic = topic if topic.startswith("/") else f"/{topic}"
        self._expected_size = expected_size
        self._timeout_s = timeout_s
        self._grey_weights = grey_weights
        super().__init__("calibration")
        self._waiting: deque[Image] = deque(maxlen=KEPT_FRAMES)
        self._arrived = threading.Condition()

    def _subscribe(self) -> None:
        self._subscription = self.node.create_subscription(
            Image, self._topic, self._on_image, qos_profile_sensor_data
        )

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        """Frames as they come, (H, W) or (H, W, 3) BGR; those that come meanwhile are dropped.

        Raises FrameSourceError where none comes in time, or one that is not the sensor's.
        """
        while True:
            yield self._decoded(self._next())

    def _next(self) -> Image:
        end = time.monotonic() + self._timeout_s
        with self._arrived:
            while not self._waiting:
                # Short waits, so that Ctrl-C is heard.
                self._arrived.wait(0.1)
                if not self._waiting and time.monotonic() > end:
                    raise FrameSourceError(self._silence())
            return self._waiting.popleft()

    def _decoded(self, message: Image) -> NDArray[np.uint8]:
        try:
            image = image_from_msg(message, self._grey_weights)
        except CmpTactileError as error:
            msg = f"{self._topic}: {error}"
            raise FrameSourceError(msg) from None
        size = (image.shape[1], image.shape[0])
        self._expected_size = self._expected_size or size
        if size != self._expected_size:
            msg = (
                f"{self._topic}: found frames of {size_text(size)}, "
                f"expected {size_text(self._expected_size)}"
            )
            raise FrameSourceError(msg)
        return image

    def _silence(self) -> str:
        """Why nothing came, as far as that can be seen from here."""
        waited = f"{self._topic}: no frame within {self._timeout_s:g} s"
        if self._subscription.get_publisher_count():
            return f"{waited}, though there is a publisher: is the camera running?"
        topics = self.node.get_topic_names_and_types()
        images = sorted(
            name for name, types in topics if IMAGE_TYPE in types and name != self._topic
        )
        there = f"there are {', '.join(images)}" if images else "there is no image topic at all"
        return f"{waited}: nobody publishes it, {there} (ROS_DOMAIN_ID is the same?)"

    def _on_image(self, message: Image) -> None:
        with self._arrived:
            self._waiting.append(message)
            self._arrived.notify_all()
