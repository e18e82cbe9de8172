"""Node: publishes the frames of a camera, or of what stands for one, managed by its lifecycle."""

from __future__ import annotations

import sys
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from cmp_tactile_driver.nodes.camera_calibration import CameraCalibration, image_qos
from cmp_tactile_driver.sources import frames
from cmp_tactile_driver.sources.capture import Capture, CaptureState, on_clock
from cmp_tactile_driver.sources.parameters import CameraDriverParameters, CameraParameters
from cmp_tactile_driver.v4l2.control_parameters import PREFIX
from cmp_tactile_processing.errors import (
    CmpTactileError,
    Finding,
    FrameSourceError,
    InputError,
    Severity,
)
from cmp_tactile_processing.ros.base_nodes import ReportingNode
from cmp_tactile_processing.ros.diagnostics import SentFrames
from cmp_tactile_processing.ros.messages.conversions import frame_to_msg, header_at
from cmp_tactile_processing.ros.messages.making import camera_frame
from cmp_tactile_processing.ros.parameters import SensorParameters, declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.sensor.description import load_sensor

# The one source that is opened by another parameter than `input`.
CAMERA = "v4l2"


def _state_finding(
    problem: str, capture: Capture | None, health: frames.SourceHealth, name: str
) -> Finding:
    """What is to be reported.

    problem: why it could not be configured.  name: of what it reads.
    """
    if problem:
        return Finding(Severity.ERROR, problem)
    if capture is None:
        return Finding(Severity.WARNING, "not configured")
    if capture.state is CaptureState.FAILED:
        return Finding(Severity.ERROR, capture.failure)
    if capture.state is CaptureState.ENDED:
        return Finding(Severity.WARNING, f"{CaptureState.ENDED.value}: {name}")
    return health.finding


class CameraDriver(ReportingNode, LifecycleNode):
    """Publishes `image_raw` and `camera_info` while active, and `/diagnostics` always.

    With `autostart` it waits for a camera that is missing, then starts.
    If a source cannot be opened, the node stays unconfigured and the diagnostics say why; correct
    the cause and configure it again.  Raises CmpTactileError for wrong parameters.

    Camera frames have the time of their exposure as stamp, frames of other sources the time of
    publishing.  A camera that was unplugged is found again by its serial number.

    The parameters from `device` on are for the source `v4l2`.  While the node is configured, each
    control of the camera is a parameter `controls.NAME` (docs/camera.md).

    Topics and services below `indenter/` and `truth/`, and the parameters from `autoplay` to
    `samples`, are for the source `simulated`.  Targets and loads are in the gel frame.  A target is
    the position of the indenter's origin.  A load presses into the gel: its `force.z` is negative.
    A message that cannot be used is refused with a warning.  `truth/` is published only while
    somebody subscribes.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("camera_driver", **node_kwargs)
        self._source: frames.FrameSource | None = None
        self._extension: frames.NodeExtension | None = None
        self._capture: Capture | None = None
        self._problem = ""
        self._sent = SentFrames()
        self._silence = ""
        self._may_come = self._is_attempt = False
        with self.destroyed_on_error():
            self._set_up()

    def destroy_node(self) -> None:
        """Stop, give the source back, then destroy the node."""
        self._release()
        super().destroy_node()
        # rclpy leaves it alive, and with it the node in the ROS graph until garbage is collected.
        self._state_machine.destroy_when_not_in_use()

    def _set_up(self) -> None:
        own = declare_parameters(self, SensorParameters())
        self._settings = declare_parameters(self, CameraDriverParameters())
        self._camera_settings = CameraParameters()
        if self._settings.source == CAMERA:
            self._camera_settings = declare_parameters(self, self._camera_settings)
        elif not self._settings.input:
            # It cannot be given later: nothing would ever be published.
            name = self.get_fully_qualified_name()
            msg = (
                f"{name}: parameter input: found nothing, expected a folder, file or scene to open"
            )
            raise InputError(msg)
        self._open = frames.find_source(self._settings.source)
        self._sensor = load_sensor(own.sensor_description, own.sensor_name)
        self._frame_id = camera_frame(self._sensor)
        self._calibration = CameraCalibration(self, self._sensor, self._settings.camera_info_url)
        publisher = self.create_lifecycle_publisher(
            Image,
            "image_raw",
            image_qos(),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        self._image = self.add_output(publisher, frame_to_msg, own_thread=True)
        self._info_publisher = self.create_lifecycle_publisher(
            CameraInfo, "camera_info", image_qos()
        )
        self.start_reporting()
        delay = self._camera_settings.reconnect_delay
        self._retry = self.create_steady_timer(delay, self._attempt_start, autostart=False)
        if self._settings.autostart:
            self._attempt_start()
            if not self._retry.is_canceled():
                self.get_logger().info("the node tries again until the camera is there")

    def _attempt_start(self) -> None:
        """Configure and activate, now and, while a missing camera may come, after each delay."""
        self._retry.cancel()
        if self._state_machine.current_state[0] != State.PRIMARY_STATE_UNCONFIGURED:
            return
        self._is_attempt = True
        try:
            configured = self.trigger_configure() is TransitionCallbackReturn.SUCCESS
        finally:
            self._is_attempt = False
        if configured:
            self.trigger_activate()
        elif self._may_come:
            self._retry.reset()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the source."""
        try:
            self._source = self._open_source()
            if isinstance(self._source, frames.WithNodeExtension):
                self._extension = self._source.extend(self)
        except CmpTactileError as error:
            self._release()
            is_known = self._is_attempt and self._problem == str(error)
            self._problem = str(error)
            self._may_come = isinstance(error, FrameSourceError) and error.may_come
            if not is_known:
                self.get_logger().error(self._problem)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001  rclpy would end in an error and say nothing
            self._release()
            self._may_come = False
            return self._unexpected(error)
        self._problem = ""
        self._retry.cancel()
        # Source and extension have declared theirs; an unknown control is an error anyway.
        self.warn_of_unknown_parameters(*((PREFIX,) if self._settings.source == CAMERA else ()))
        self._capture = Capture(self._source, self._send)
        rate = f"{self._source.frame_rate:g} Hz" if self._source.frame_rate else "its own rate"
        self.get_logger().info(f"{self._source.name} at {rate}")
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish from now on; a camera that cannot be started leaves the node inactive."""
        result = super().on_activate(state)
        try:
            if self._capture is not None:
                self._capture.start()
        except CmpTactileError as error:
            self._problem = str(error)
            self.get_logger().error(self._problem)
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001  as above
            super().on_deactivate(state)
            return self._unexpected(error)
        self._problem = ""
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
        self._retry.cancel()
        self._release()
        return super().on_shutdown(state)

    def on_error(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Give the source back; the node can be configured again."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _unexpected(self, error: Exception) -> TransitionCallbackReturn:
        self._problem = f"{self._opened}: unexpected error: {type(error).__name__}: {error}"
        self.get_logger().error(f"{self._problem}\n{traceback.format_exc()}")
        return TransitionCallbackReturn.FAILURE

    def _open_source(self) -> frames.FrameSource:
        settings = self._settings
        options = frames.SourceOptions(
            settings.input,
            self._sensor,
            settings.frame_rate,
            settings.loop,
            self._camera_settings,
        )
        return self._open(options)

    def _send(self, frame: frames.Frame) -> None:
        stamp = self._stamp(frame)
        header = header_at(stamp.to_msg(), self._frame_id)
        self._image.publish(frame.image, header)
        if self._info_publisher.get_subscription_count():
            self._info_publisher.publish(self._calibration.message(header))
        age = (self.get_clock().now() - stamp).nanoseconds * 1e-9
        self._sent.sent(age)
        if self._extension is not None:
            self._extension.frame_sent(frame, header)

    def _stamp(self, frame: frames.Frame) -> Time:
        clock = self.get_clock()
        now = clock.now()
        if frame.monotonic_ns is None:
            return now
        exposed_ns = on_clock(frame.monotonic_ns, lambda: clock.now().nanoseconds)
        return Time(nanoseconds=max(0, exposed_ns), clock_type=now.clock_type)

    def _release(self) -> None:
        if isinstance(self._source, frames.InterruptibleSource):
            self._source.interrupt()
        if self._capture is not None:
            self._capture.stop()
            self._capture = None
        if self._extension is not None:
            self._extension.close()
            self._extension = None
        if self._source is not None:
            self._source.close()
            self._source = None

    def _status(self) -> DiagnosticStatus:
        health = self._source.health if self._source is not None else frames.SourceHealth()
        self._log_silence(health)
        capture, calibration = self._capture, self._calibration.problem
        findings = [
            _state_finding(self._problem_text, capture, health, self._opened),
            Finding(Severity.WARNING, calibration),
        ]
        values: dict[str, object] = {
            "state": self._state_machine.current_state[1],
            "source": self._source.name if self._source is not None else self._opened,
            "frames out": capture.frames if capture is not None else 0,
            "bad frames": health.bad_frames,
            "dropped frames": health.dropped_frames,
            **self._sent.close_period(),
            "problem": health.problem,
            "calibration": calibration or "as described",
            **({} if self._extension is None else self._extension.diagnostics),
        }
        state = capture.state.value if capture is not None else ""
        return self.status_of(self._sensor.ros_name, values, findings, state)

    @property
    def _opened(self) -> str:
        settings = self._settings
        return self._camera_settings.device if settings.source == CAMERA else settings.input

    @property
    def _problem_text(self) -> str:
        more = (
            "" if self._retry.is_canceled() else "; the node tries again until the camera is there"
        )
        return self._problem and self._problem + more

    def _log_silence(self, health: frames.SourceHealth) -> None:
        before, self._silence = self._silence, health.problem if health.silent else ""
        if self._silence and not before:
            self.get_logger().error(f"no frames: {self._silence}")
        elif before and not self._silence and self._source is not None:
            self.get_logger().info(f"frames are received again: {self._source.name}")


def main() -> int:
    """Run the node as a process."""
    return run_node(CameraDriver)


if __name__ == "__main__":
    sys.exit(main())
