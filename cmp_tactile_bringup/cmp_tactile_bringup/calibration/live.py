"""A running sensor: its frames, beside a reference force sensor, and under weights."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image

from cmp_tactile_bringup.calibration import gel_recording
from cmp_tactile_bringup.calibration.loads import WrenchSeries, averaged, weight_on_gel
from cmp_tactile_driver.bags.reader import COMPRESSED_IMAGE, IMAGE
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.frames import size_text
from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.image.encodings import COMPRESSED, BitDepth
from cmp_tactile_processing.measured import Markers3D
from cmp_tactile_processing.pipeline import MarkerCamera
from cmp_tactile_processing.ros.messages.reading import image_from_msg, stamp_ns
from cmp_tactile_processing.ros.process import Listener
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.stillness import largest_motion, motion_limit

IMAGE_TYPES = {Image: IMAGE, CompressedImage: COMPRESSED_IMAGE}
# A camera is faster than a board is found: of what waits, only the newest is worth looking at.
KEPT_FRAMES = 4
MOST_REST_FRAMES = 50
# Frames that were taken before the weight was on may still be waiting.
STALE_FRAMES = 4

Ask = Callable[[str], object]
Say = Callable[[str], None]


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
            image = image_from_msg(message, self._sensor.tracking.grey_weights, self._depth)
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


class LiveReference(LiveFrames):
    """Frames of an image topic and wrenches of a WrenchStamped topic; a context manager."""

    def __init__(
        self, topic: str, sensor: SensorDescription, timeout_s: float, wrench_topic: str
    ) -> None:
        super().__init__(topic, sensor, timeout_s)
        self._wrench_topic = wrench_topic
        self._wrenches: dict[int, list[float]] = {}

    def _subscribe(self) -> None:
        super()._subscribe()
        self._wrench_subscription = self.node.create_subscription(
            WrenchStamped, self._wrench_topic, self._on_wrench, qos_profile_sensor_data
        )

    def record(
        self, duration_s: float, report: Callable[[str, float], None]
    ) -> tuple[gel_recording.GelMotion, WrenchSeries]:
        """Gel and force over so many seconds, which begin with the gel at rest.

        Raises FrameSourceError where no frame comes, RecordingError where no wrench does or the
        frames cannot serve.
        """
        camera = MarkerCamera(self._sensor)
        stamps: list[int] = []
        markers: list[Markers3D] = []
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < duration_s or len(stamps) < 2:
            report("recording", min(passed / duration_s, 1.0))
            message = self._next()
            stamps.append(stamp_ns(message.header.stamp))
            markers.append(camera.measure(self._decoded(message))[1])
        report("recording", 1.0)
        wrenches = WrenchSeries.from_rows(self._wrench_topic, dict(self._wrenches))
        rest = gel_recording.leading_frames(
            np.stack([item.position for item in markers]), MOST_REST_FRAMES
        )
        frames = np.array(stamps, np.int64), markers
        return gel_recording.displaced(self._topic, self._sensor, frames, rest), wrenches

    def _on_wrench(self, message: WrenchStamped) -> None:
        force = message.wrench.force
        self._wrenches[stamp_ns(message.header.stamp)] = [force.x, force.y, force.z]


@dataclass
class Weighing:
    """Takes frames of a gel at rest and under each weight.

    frames: of the camera, as they come; count: taken of each load; ask: puts a text to whoever
    holds the weights and waits; say: what came of it.
    """

    sensor: SensorDescription
    frames: Iterator[NDArray[np.uint8]]
    count: int
    ask: Ask
    say: Say
    _markers: list[Markers3D] = field(default_factory=list)

    def samples(self, masses: Sequence[float]) -> list[LoadSample]:
        """A sample for each mass in kg; errors as `displaced`, and those of the frames."""
        camera = MarkerCamera(self.sensor)
        self._take(camera, "Let nothing touch the gel")
        for mass in masses:
            self._take(camera, f"Put {mass:g} kg on the gel, then let go of it")
        motion = self._motion()
        return [
            self._sample(motion, mass, range(number * self.count, (number + 1) * self.count))
            for number, mass in enumerate(masses, 1)
        ]

    def _take(self, camera: MarkerCamera, wish: str) -> None:
        """Ask until the gel is still."""
        while True:
            self.ask(f"{wish}, then press Enter. ")
            fresh = islice(self.frames, STALE_FRAMES, STALE_FRAMES + self.count)
            taken = [camera.measure(image)[1] for image in fresh]
            position = np.stack([item.position for item in taken])
            moved = max(largest_motion(position[0], item) for item in position[1:])
            limit = motion_limit(position)
            if moved <= limit:
                self._markers += taken
                return
            self.say(
                f"The gel moves by {moved * 1e6:.0f} um, expected at most {limit * 1e6:.0f} um: "
                "wait until it is still, then try again."
            )

    def _motion(self) -> gel_recording.GelMotion:
        # Frames of a topic differ by their order alone.
        stamps = np.arange(len(self._markers), dtype=np.int64)
        return gel_recording.displaced(
            "live", self.sensor, (stamps, self._markers), range(self.count)
        )

    def _sample(self, motion: gel_recording.GelMotion, mass: float, frames: range) -> LoadSample:
        force, std = weight_on_gel(mass)
        return LoadSample(*averaged(motion, frames), force, std, name=f"{mass:g} kg")
