"""Node: publishes the frames of a video, image folder or simulator, managed by its lifecycle."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Image

from cmp_tactile_driver.capture import Capture, CaptureState
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import (
    Frame,
    FrameSource,
    NodeExtension,
    SourceHealth,
    SourceOptions,
    WithNodeExtension,
)
from cmp_tactile_driver.nodes.camera_messages import camera_info_of, image_qos
from cmp_tactile_driver.nodes.node_parameters import declare_parameters
from cmp_tactile_driver.parameters import CameraDriverParameters
from cmp_tactile_driver.source_registry import find_source
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.nodes.conversions import header_at
from cmp_tactile_processing.nodes.frames import camera_frame
from cmp_tactile_processing.nodes.images import image_to_msg
from cmp_tactile_processing.nodes.process import run_node
from cmp_tactile_processing.sensor_library import load_sensor

__all__ = ["CameraDriver"]

REPORT_PERIOD = 1.0


class CameraDriver(LifecycleNode):
    """Publishes `image_raw` and `camera_info` while active, and `/diagnostics` always.

    A source that cannot be opened leaves the node unconfigured, with the reason in the
    diagnostics; it can be configured again.  Raises CmpTactileError for wrong parameters.

    The topics and the service that begin with `indenter/` and `truth/`, and the parameters from
    `autoplay` on, are those of the source `simulated`.  Targets and loads are in the gel frame: a
    target is the place of the indenter's origin, a load has `force.z` below 0, into the gel.  What
    cannot be used is refused with a warning.  `truth/` is made only while somebody subscribes.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("camera_driver", **node_kwargs)
        self._source: FrameSource | None = None
        self._extension: NodeExtension | None = None
        self._capture: Capture | None = None
        self._problem = ""
        self._last_report = (time.monotonic(), 0)
        try:
            self._set_up()
        except BaseException:
            self.destroy_node()
            raise

    def destroy_node(self) -> None:
        """Stop, give the source back, then destroy the node."""
        self._release()
        super().destroy_node()
        # rclpy leaves it alive, and with it the node in the ROS graph until garbage is collected.
        self._state_machine.destroy_when_not_in_use()

    def _set_up(self) -> None:
        self._settings = declare_parameters(self, CameraDriverParameters())
        self._open = find_source(self._settings.source)
        self._sensor = load_sensor(self._settings.sensor_description, self._settings.sensor_name)
        self._frame_id = camera_frame(self._sensor)
        self._image_publisher = self.create_lifecycle_publisher(
            Image,
            "image_raw",
            image_qos(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._info_publisher = self.create_lifecycle_publisher(
            CameraInfo, "camera_info", image_qos()
        )
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(REPORT_PERIOD, self._report, clock=steady)
        if self._settings.autostart:
            configured = self.trigger_configure() is TransitionCallbackReturn.SUCCESS
            if configured:
                self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the source."""
        try:
            self._source = self._open_source()
            if isinstance(self._source, WithNodeExtension):
                self._extension = self._source.extend(self)
        except CmpTactileError as error:
            self._release()
            self._problem = str(error)
            self.get_logger().error(self._problem)
            return TransitionCallbackReturn.FAILURE
        self._problem = ""
        self._capture = Capture(self._source, self._send)
        self.get_logger().info(f"{self._source.name} at {self._source.frame_rate:g} Hz")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish from now on."""
        result = super().on_activate(state)
        if self._capture is not None:
            self._capture.start()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish no more; the source stays open where it is."""
        if self._capture is not None:
            self._capture.stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give the source back."""
        self._release()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Give the source back for good."""
        self._release()
        return super().on_shutdown(state)

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Give the source back; the node can be configured again."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _open_source(self) -> FrameSource:
        settings = self._settings
        if not settings.input:
            msg = f"{self.get_name()}: parameter input: found nothing, expected what to open"
            raise FrameSourceError(msg)
        options = SourceOptions(settings.input, self._sensor, settings.frame_rate, settings.loop)
        return self._open(options)

    def _send(self, frame: Frame) -> None:
        header = header_at(self.get_clock().now().to_msg(), self._frame_id)
        self._info_publisher.publish(camera_info_of(self._sensor, header))
        self._image_publisher.publish(image_to_msg(frame.image, frame.encoding, header))
        if self._extension is not None:
            self._extension.frame_sent(frame, header)

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.stop()
            self._capture = None
        if self._extension is not None:
            self._extension.close()
            self._extension = None
        if self._source is not None:
            self._source.close()
            self._source = None

    def _report(self) -> None:
        array = DiagnosticArray(status=[self._status()])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(array)

    def _status(self) -> DiagnosticStatus:
        health = self._source.health if self._source is not None else SourceHealth()
        frames = self._capture.frames if self._capture is not None else 0
        now, (before, frames_before) = time.monotonic(), self._last_report
        self._last_report = (now, frames)
        level, message = self._judge(health)
        values: dict[str, object] = {
            "state": self._state_machine.current_state[1],
            "source": self._source.name if self._source is not None else self._settings.input,
            "frames": frames,
            "bad frames": health.bad_frames,
            "rate (Hz)": f"{max(0, frames - frames_before) / max(now - before, 1e-9):.2f}",
            "problem": health.problem,
            **self._extra_values(),
        }
        return DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name().lstrip("/"),
            message=message,
            hardware_id=self._sensor.ros_name,
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )

    def _extra_values(self) -> Mapping[str, object]:
        return {} if self._extension is None else self._extension.diagnostics

    def _judge(self, health: SourceHealth) -> tuple[bytes, str]:
        if self._problem:
            return DiagnosticStatus.ERROR, self._problem
        if self._capture is None:
            return DiagnosticStatus.WARN, "not configured"
        if self._capture.state is CaptureState.FAILED:
            return DiagnosticStatus.ERROR, self._capture.failure
        if self._capture.state is CaptureState.ENDED:
            return DiagnosticStatus.WARN, f"{CaptureState.ENDED.value}: {self._settings.input}"
        if health.problem:
            return DiagnosticStatus.WARN, health.problem
        return DiagnosticStatus.OK, self._capture.state.value


def main() -> int:
    """Run the node as a process."""
    return run_node(CameraDriver)


if __name__ == "__main__":
    sys.exit(main())
