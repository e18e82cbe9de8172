"""Node: plays a recorded bag, a folder of images, an image or a video as the sensor would."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.time import Time
from rosgraph_msgs.msg import Clock as ClockMsg
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import SetBool, Trigger

from cmp_tactile_driver.bags.player import Player, PlayerState, StartGate
from cmp_tactile_driver.bags.reader import RecordedCameraInfo, RecordedFrame, RecordedMessage
from cmp_tactile_driver.bags.recording import open_recording_of
from cmp_tactile_driver.nodes.camera_calibration import camera_info_of, image_qos
from cmp_tactile_driver.sources.parameters import ReplayParameters
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.cache.files import split_paths
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.ros.base_nodes import ReportingNode, latched_qos
from cmp_tactile_processing.ros.diagnostics import SentFrames
from cmp_tactile_processing.ros.messages.conversions import (
    frame_to_msg,
    header_at,
    surface_to_msg,
    with_header,
)
from cmp_tactile_processing.ros.messages.making import camera_frame, gel_frame
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.wiring import input_of
from cmp_tactile_processing.sensor.description import load_sensor

SETTLE_TIME = 0.2
"""From the last subscriber, or the last replay, to the beginning, s.

The subscriber's side of the match may still be under way, and all replays are to know of the last.
"""

STATUS_CHECK_PERIOD = 0.1
# A second of frames: what a subscriber on a busy machine has not taken yet is not given up.
PUBLISHER_DEPTH = 60
# /clock goes on not quicker than that, s, as with ros2 bag: it wakes every node that listens.
CLOCK_PERIOD = 0.025
# By how much ~/back and ~/forward go.
JUMP_S = 1.0


class CommonStart:
    """Each replay reports on its `~/ready` since when it is; all begin a moment after the last.

    The time is that of the system's clock, so that replays of one machine begin at once whatever
    the messages between them take.
    """

    def __init__(self, node: Node, is_ready: Callable[[], bool], others: str) -> None:
        """is_ready: whether the subscribers are there.  others: full names of the other replays."""
        self._is_ready = is_ready
        self._since_ns: dict[str, int | None] = {"": None}
        self._name = node.get_fully_qualified_name()
        self._publisher = node.create_publisher(Header, "~/ready", latched_qos())
        for other in others.split():
            name = f"/{'/'.join(part for part in other.split('/') if part)}"
            self._since_ns[name] = None
            node.create_subscription(Header, f"{name}/ready", self._keeper_for(name), latched_qos())

    def remaining(self) -> float | None:
        """Seconds until the beginning; None as long as somebody is not ready.  From any thread."""
        if self._since_ns[""] is None:
            if not self._is_ready():
                return None
            self._since_ns[""] = time.time_ns()
            stamp = Time(nanoseconds=self._since_ns[""]).to_msg()
            self._publisher.publish(Header(stamp=stamp, frame_id=self._name))
        known = [since for since in self._since_ns.values() if since is not None]
        if len(known) < len(self._since_ns):
            return None
        passed = (time.time_ns() - max(known)) / NS_PER_S
        # A clock of another machine may differ by anything.
        return min(max(0.0, SETTLE_TIME - passed), SETTLE_TIME)

    def missing(self) -> list[str]:
        """Other replays that are not ready.  From any thread."""
        return [name for name, since in self._since_ns.items() if name and since is None]

    def _keeper_for(self, name: str) -> Callable[[Header], None]:
        def keep(message: Header) -> None:
            self._since_ns[name] = Time.from_msg(message.stamp).nanoseconds

        return keep


class Replay(ReportingNode):
    """Publishes `image_raw`, `camera_info` and `/clock` from a recording, stamps as recorded.

    From a bag without images it publishes `surface`.  Compressed frames are decompressed.  No frame
    is left out: if publishing is slow, or the next stage of its container has 20 frames to do,
    later frames are delayed.  A stage that takes the newest only (`frame_queue`) passes others
    over; they are counted and reported.  `~/pause` pauses and continues,
    `~/step` sends the next frame while paused, `~/back` and `~/forward` jump by one second.
    `~/status` (latched) reports state and counts, also after the end.
    Replays with `begin_with` start together: they exchange `~/ready` (std_msgs/Header, latched).
    Raises CmpTactileError if the parameters or the recording cannot be used.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("replay", **node_kwargs)
        self._player: Player | None = None
        # Why the recording cannot be played, once that was reported.  From any thread.
        self.failure = ""
        self._clock_ns, self._clock_sent = 0, -math.inf
        self._sent = SentFrames()
        with self.destroyed_on_error():
            self._set_up()

    def destroy_node(self) -> None:
        """Stop playing, then destroy the node."""
        if self._player is not None:
            self._player.stop()
        super().destroy_node()

    def _set_up(self) -> None:
        self._settings = declare_parameters(self, ReplayParameters(), dynamic=("rate", "start"))
        inputs = split_paths(self._settings.input)
        if not inputs:
            msg = (
                f"{self.get_name()}: parameter input: found nothing, expected a bag, folder or file"
            )
            raise FrameSourceError(msg)
        self._sensor = load_sensor(self._settings.sensor_description, self._settings.sensor_name)
        self._info = camera_info_of(self._sensor, Header()) if self._sensor.views else None
        self._recordings = [
            open_recording_of(
                self._sensor,
                path,
                topic=self._settings.topic,
                frame_rate=self._settings.frame_rate,
                frame_id=camera_frame(self._sensor),
                any_size=True,
            )
            for path in inputs
        ]
        self._names = ", ".join(item.name for item in self._recordings)
        if len({item.of_surfaces for item in self._recordings}) > 1:
            msg = (
                f"{self._names}: found surfaces in some recordings and images in others, expected "
                "the same kind in all"
            )
            raise FrameSourceError(msg)
        for recording in self._recordings:
            if mismatch := recording.calibration_mismatch(self._sensor):
                self.get_logger().warning(f"{recording.name}: {mismatch}")
        self._create_publishers()
        self._player = self._make_player()
        self._reported: tuple[PlayerState, int] | None = None
        self._reported_losses = 0
        self._warned: set[str] = set()
        self.add_post_set_parameters_callback(self._use_parameters)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/step", self._on_step)
        self.create_service(Trigger, "~/back", partial(self._on_jump, -JUMP_S))
        self.create_service(Trigger, "~/forward", partial(self._on_jump, JUMP_S))
        self.create_steady_timer(STATUS_CHECK_PERIOD, self._report_change)
        self.start_reporting(also_to=[self._status_publisher])
        self.warn_of_unknown_parameters()
        self._player.start()

    def _create_publishers(self) -> None:
        overridable = QoSOverridingOptions.with_default_policies()
        qos = image_qos()
        qos.depth = PUBLISHER_DEPTH
        kind, topic, to_msg = (
            (SurfaceMsg, "surface", surface_to_msg)
            if self._recordings[0].of_surfaces
            else (Image, "image_raw", frame_to_msg)
        )
        self._frame_publisher = self.create_publisher(
            kind, topic, qos, qos_overriding_options=overridable
        )
        self._frame = self.add_output(
            self._frame_publisher,
            to_msg,
            own_thread=True,
            waits=lambda: not self._require_player().is_stopping,
        )
        self._info_publisher = self.create_publisher(CameraInfo, "camera_info", qos)
        self._clock_publisher = self.create_publisher(ClockMsg, "/clock", QoSProfile(depth=10))
        self._status_publisher = self.create_publisher(DiagnosticStatus, "~/status", latched_qos())

    def _make_player(self) -> Player:
        wanted, others = self._settings.wait_for_subscribers, self._settings.begin_with
        gate = None
        if wanted or others:
            publisher = self._frame_publisher
            start = CommonStart(self, lambda: publisher.get_subscription_count() >= wanted, others)
            gate = StartGate(
                start.remaining,
                self._settings.wait_timeout,
                lambda: self._warn_of_missing(start.missing()),
            )
        return Player(self._recordings, self._send, self._settings, gate)

    def _warn_of_missing(self, replays: list[str]) -> None:
        publisher, wanted = self._frame_publisher, self._settings.wait_for_subscribers
        missing, count = list(replays), publisher.get_subscription_count()
        if count < wanted:
            text = f"found {count} subscribers, expected {wanted}"
            missing.insert(0, f"{publisher.topic_name}: {text}")
        text = (
            "the replay begins, but not all subscribers or replays were there within "
            f"{self._settings.wait_timeout:g} s"
        )
        self.get_logger().warning(f"{text} (a recorder will miss frames): {', '.join(missing)}")

    def _send(self, message: RecordedMessage) -> None:
        self._publish_clock(message.time_ns)
        if isinstance(message, RecordedCameraInfo):
            self._info_publisher.publish(self._named(message.data))
            return
        stamp = Time(nanoseconds=message.stamp_ns).to_msg()
        if message.is_surface:
            header = header_at(stamp, gel_frame(self._sensor))
        else:
            named = bool(self._settings.sensor_name)
            header = header_at(stamp, camera_frame(self._sensor) if named else message.frame_id)
        self._frame.publish(message.content, header)
        if self._lacks_info(message) and self._info_publisher.get_subscription_count():
            self._info_publisher.publish(with_header(self._info, header))
        self._sent.sent()

    def _publish_clock(self, time_ns: int) -> None:
        """Not of every message, but always where time jumps."""
        now = time.monotonic()
        goes_on = 0 <= time_ns - self._clock_ns < NS_PER_S
        soon = now - self._clock_sent < CLOCK_PERIOD
        if self._settings.publish_clock and not (goes_on and soon):
            self._clock_ns, self._clock_sent = time_ns, now
            self._clock_publisher.publish(ClockMsg(clock=Time(nanoseconds=time_ns).to_msg()))

    def _named(self, camera_info: bytes) -> bytes | CameraInfo:
        """A recorded camera_info, in the frame of the sensor where that has a name of its own."""
        if not self._settings.sensor_name:
            return camera_info
        message = deserialize_message(camera_info, CameraInfo)
        message.header.frame_id = camera_frame(self._sensor)
        return message

    def _lacks_info(self, frame: RecordedFrame) -> bool:
        """Whether it is an image of the sensor's camera without a camera_info of its recording."""
        if frame.is_surface or frame.has_camera_info or self._info is None:
            return False
        height, width = frame.image.shape[:2]
        return (width, height) == self._sensor.frame_size

    def _on_pause(self, request: Any, response: Any) -> Any:
        player = self._require_player()
        player.set_paused(request.data)
        response.success = True
        response.message = player.progress.state.value
        return response

    def _on_step(self, _request: Any, response: Any) -> Any:
        player = self._require_player()
        response.success = player.step()
        response.message = (
            ""
            if response.success
            else f"found the state {player.progress.state.value}, expected paused"
        )
        return response

    def _on_jump(self, seconds: float, _request: Any, response: Any) -> Any:
        player = self._require_player()
        place = player.jump_by(seconds)
        response.success = place is not None
        state = player.progress.state.value
        response.message = (
            f"found the state {state}, expected playing or paused"
            if place is None
            else f"{state} at {place:.2f} s"
        )
        return response

    def _use_parameters(self, parameters: list[Parameter[Any]]) -> None:
        for parameter in parameters:
            if parameter.name == "rate":
                self._require_player().rate = parameter.value
            if parameter.name == "start":
                self._require_player().jump(parameter.value)

    def _require_player(self) -> Player:
        assert self._player is not None  # noqa: S101  made before any callback can run
        return self._player

    def _report_change(self) -> None:
        progress = self._require_player().progress
        if self._passed_over > self._reported_losses:
            self._reported_losses = self._passed_over
            text = f"{self._passed_over} frames were passed over so far by the next stage"
            self.get_logger().warning(text, throttle_duration_sec=1.0)
        if self._reported is None or progress.state is not self._reported[0]:
            self.report()
            text = f"{progress.state.value}: {self._names}, {progress.frames} frames sent"
            bad = f", {progress.health.bad_frames} bad" if progress.health.bad_frames else ""
            if self._passed_over:
                bad += f", {self._passed_over} passed over (frame_queue: newest)"
            if progress.state is PlayerState.FAILED:
                self.get_logger().error(f"{text}{bad}: {progress.health.problem}")
                self.failure = f"{self.get_name()}: {progress.health.problem}"
                return
            self.get_logger().info(f"{text}{bad}")
            # How far the pictures of a pair are apart is known once they were read.
            gaps = {f"{item.name}: {item.gaps}" for item in self._recordings if item.gaps}
            found = gaps | {item.health.problem for item in self._recordings} - {""}
            for text in sorted(found - self._warned):
                self.get_logger().warning(text)
            self._warned |= found

    @property
    def _passed_over(self) -> int:
        """Frames that stages of this container did not take in time."""
        return sum(input_of(end).dropped for end in self._frame.ends)

    def _status(self) -> DiagnosticStatus:
        progress = self._require_player().progress
        self._reported = (progress.state, progress.frames)
        values: dict[str, object] = {
            "state": progress.state.name.lower(),
            "frames out": progress.frames,
            "passed over": self._passed_over,
            "bad frames": progress.health.bad_frames,
            "rate (Hz)": self._sent.close_period()["rate (Hz)"],
            "passes": progress.passes,
            "position (s)": f"{progress.position:.3f}",
            "max lateness (ms)": f"{progress.max_lateness * 1e3:.1f}",
            "problem": progress.health.problem,
            "recording": self._names,
        }
        return self.status_of(
            self._sensor.ros_name, values, [progress.health.finding], progress.state.value
        )


def main() -> int:
    """Run the node as a process."""
    return run_node(Replay)


if __name__ == "__main__":
    sys.exit(main())
