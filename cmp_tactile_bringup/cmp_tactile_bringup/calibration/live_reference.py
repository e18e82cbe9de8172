"""A running sensor beside a running reference force sensor, recorded for a while."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import qos_profile_sensor_data

from cmp_tactile_bringup.calibration.gel_recording import GelMotion, MarkerCamera, displaced
from cmp_tactile_bringup.calibration.live_frames import LiveFrames
from cmp_tactile_bringup.calibration.steady_frames import leading_frames
from cmp_tactile_bringup.calibration.wrench_recording import NS_PER_S, WrenchSeries
from cmp_tactile_bringup.recordings.library import RecordingError
from cmp_tactile_processing.measured.markers_3d import Markers3D
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["LiveReference"]

MOST_REST_FRAMES = 50


class LiveReference(LiveFrames):
    """Frames of an image topic and wrenches of a WrenchStamped topic; a context manager."""

    def __init__(
        self, sensor: SensorDescription, topic: str, wrench_topic: str, timeout_s: float
    ) -> None:
        size = (sensor.image.width, sensor.image.height)
        super().__init__(topic, size, timeout_s, sensor.tracking.grey_weights)
        self._sensor = sensor
        self._wrench_topic = wrench_topic
        self._wrenches: dict[int, list[float]] = {}

    def _subscribe(self) -> None:
        super()._subscribe()
        self._wrench_subscription = self.node.create_subscription(
            WrenchStamped, self._wrench_topic, self._on_wrench, qos_profile_sensor_data
        )

    def record(
        self, duration_s: float, tell: Callable[[str, float], None]
    ) -> tuple[GelMotion, WrenchSeries]:
        """Gel and force over so many seconds, which begin with the gel at rest.

        Raises FrameSourceError where no frame comes, RecordingError where no wrench does or the
        frames cannot serve.
        """
        camera = MarkerCamera(self._sensor)
        stamps: list[int] = []
        markers: list[Markers3D] = []
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < duration_s or len(stamps) < 2:
            tell("recording", min(passed / duration_s, 1.0))
            message = self._next()
            stamp = message.header.stamp
            stamps.append(stamp.sec * NS_PER_S + stamp.nanosec)
            markers.append(camera.markers(self._decoded(message)))
        tell("recording", 1.0)
        wrenches = self._series()
        rest = leading_frames(np.stack([item.position for item in markers]), MOST_REST_FRAMES)
        frames = np.array(stamps, np.int64), markers
        return displaced(self._topic, self._sensor, frames, rest), wrenches

    def _series(self) -> WrenchSeries:
        rows = dict(self._wrenches)
        if len(rows) < 2:
            msg = (
                f"{self._wrench_topic}: found {len(rows)} wrenches while recording, "
                "expected two or more: is the force sensor running?"
            )
            raise RecordingError(msg)
        stamps = sorted(rows)
        wrench = np.array([rows[stamp] for stamp in stamps])
        return WrenchSeries(self._wrench_topic, np.array(stamps, np.int64), wrench)

    def _on_wrench(self, message: WrenchStamped) -> None:
        stamp = message.header.stamp
        force, torque = message.wrench.force, message.wrench.torque
        row = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
        self._wrenches[stamp.sec * NS_PER_S + stamp.nanosec] = row
