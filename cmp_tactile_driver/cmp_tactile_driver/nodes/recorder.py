"""Node: records a sensor's topics into a bag, once somebody publishes them."""

from __future__ import annotations

import sys
from collections import Counter
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import NoTypeSupportImportedException
from rclpy.type_support import check_for_type_support
from std_srvs.srv import SetBool

from cmp_tactile_driver.bags.reader import IMAGE
from cmp_tactile_driver.bags.recorder import BagRecorder, RecorderState, RecordingProgress, Tap
from cmp_tactile_driver.bags.writer import BagWriter, put_sensor_beside
from cmp_tactile_driver.errors import BagError, BagWriteError
from cmp_tactile_driver.nodes.camera_calibration import latched_qos
from cmp_tactile_driver.nodes.recorded_topics import (
    FoundTopic,
    TopicWatch,
    frame_encoder,
    message_encoder,
)
from cmp_tactile_driver.sources.parameters import MEGABYTE, RecorderParameters
from cmp_tactile_processing.ros.base_nodes import ReportingNode
from cmp_tactile_processing.ros.diagnostics import Finding, LossWatch, SentFrames
from cmp_tactile_processing.ros.messages.conversions import message_class
from cmp_tactile_processing.ros.parameters import declare_parameters
from cmp_tactile_processing.ros.process import run_node
from cmp_tactile_processing.ros.wiring import Given, Input
from cmp_tactile_processing.sensor.description import load_sensor

SEARCH_PERIOD_S = 0.2
EARLY_LIMIT = 1000


class Recorder(ReportingNode):
    """Records topics into a bag that `replay`, `ros2 bag` and other readers of MCAP take.

    Each message is stored with the time of its arrival.
    `compression` applies to frames.  With png and jpeg they are stored as `image_raw/compressed`;
    if only that topic is published, it is recorded in place of `image_raw`.  A topic is recorded
    reliably if its publishers are reliable when it is found.  The sensor description is stored
    as `sensor.yaml` in the same folder.  If the disk is too slow, messages are dropped and counted.
    If the bag cannot be written, the recording ends; what was written is kept and the diagnostics
    say why.
    `~/record` starts and stops: a second recording takes the folder with _2 after its name.
    `~/status` (latched) reports state and counts.
    Raises CmpTactileError if the parameters or the folder cannot be used.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("recorder", **node_kwargs)
        self._recorder: BagRecorder | None = None
        self._taken = SentFrames()
        with self.destroyed_on_error():
            self._set_up()

    @property
    def progress(self) -> RecordingProgress | None:
        """Of the recording, also when it is over; None before the first.  From any thread."""
        return self._recorder.progress if self._recorder is not None else None

    @property
    def missing_topics(self) -> list[str]:
        """Topics that are to be recorded and that nobody has published yet."""
        return self._watch.missing

    def destroy_node(self) -> None:
        """Close the bag, then destroy the node."""
        if self._recorder is not None:
            self._recorder.stop()
        super().destroy_node()

    def _set_up(self) -> None:
        self._settings = declare_parameters(self, RecorderParameters())
        self._sensor = load_sensor(self._settings.sensor_description, self._settings.sensor_name)
        topics = self._settings.topics.replace(",", " ").split()
        if not topics:
            msg = f"{self.get_name()}: parameter topics: found none, expected at least one"
            raise BagWriteError(msg)
        self._watch = TopicWatch(self, topics)
        # Of the recording.
        self.bag: Path | None = None
        self._taps: list[tuple[Tap, LossWatch]] = []
        self._lost: Counter[str] = Counter()
        self._early: list[tuple[Tap, Any]] = []
        self._reported: RecorderState | None = None
        self._status_publisher = self.create_publisher(DiagnosticStatus, "~/status", latched_qos())
        self.create_service(SetBool, "~/record", self._on_record)
        if self._settings.autostart:
            self._start()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(SEARCH_PERIOD_S, self._look_for_topics, clock=steady)
        self.start_reporting(also_to=[self._status_publisher])
        self.warn_of_unknown_parameters()
        self.report()

    def _is_recording(self) -> bool:
        progress = self.progress
        return progress is not None and progress.state is RecorderState.RECORDING

    def _start(self) -> None:
        """Begin a recording; CmpTactileError where its folder cannot be made."""
        settings = self._settings
        folder = self._next_folder()
        writer = BagWriter(folder, compressed=settings.compression == "zstd")
        try:
            put_sensor_beside(folder, settings.sensor_description, settings.sensor_name)
        except BagWriteError:
            writer.close()
            raise
        self.bag = folder
        self._recorder = BagRecorder(writer, round(settings.queue_size * MEGABYTE))
        self._watch.forget()
        self._look_for_topics()
        self.get_logger().info(f"recording to {folder}")

    def stop(self) -> None:
        """End the recording: what waits is written, and the bag is closed."""
        self._count_losses()
        for _, watch in self._taps:
            self.disconnect_input(watch.end)
        self._taps.clear()
        self._lost.clear()
        self._early.clear()
        if self._recorder is not None:
            self._recorder.stop()

    def _next_folder(self) -> Path:
        output = self._settings.output
        if not output:
            when = datetime.now().strftime("%Y_%m_%d-%H_%M_%S")  # noqa: DTZ005  as rosbag2 does
            output = f"{self._sensor.ros_name}_{when}"
        first = Path(output).expanduser()
        if self.bag is None:
            return first
        number = 2
        while (folder := first.with_name(f"{first.name}_{number}")).exists():
            number += 1
        return folder

    def _look_for_topics(self) -> None:
        if self._is_recording() and not self._watch.is_over:
            for topic in self._watch.new_topics():
                self._subscribe(topic)

    def _subscribe(self, topic: FoundTopic) -> None:
        try:
            kind = message_class(topic.kind)
            check_for_type_support(kind)
        except (ImportError, AttributeError, NoTypeSupportImportedException):
            text = "found no such message type, expected its package to be built for this Python"
            self.get_logger().warning(f"{topic.name}: not recorded: {topic.kind}: {text}")
            return
        if topic.instead_of:
            text = f"not published; {topic.name} is recorded instead"
            self.get_logger().warning(f"{topic.instead_of}: {text}")
        tap = self._tap(topic)
        end = Input(lambda given: partial(self._on_message, tap, watch, given))
        watch = LossWatch(end)
        self.connect_input(end, kind, tap.topic, topic.qos)
        self._taps.append((tap, watch))

    def _tap(self, topic: FoundTopic) -> Tap:
        codec = self._settings.compression
        if topic.kind == IMAGE and codec in ("png", "jpeg"):
            encode = frame_encoder(topic.name, codec, self._settings.jpeg_quality)
        else:
            encode = message_encoder(topic.name, topic.kind)
        return Tap(topic.name, encode, topic.offered)

    def _count_losses(self) -> None:
        for tap, watch in self._taps:
            new = watch.lost - self._lost[tap.topic]
            if new and self._recorder is not None:
                self._lost[tap.topic] += new
                self._recorder.lost(tap, new)

    def _on_message(self, tap: Tap, watch: LossWatch, given: Given) -> None:
        message = given.message
        watch.take(given.info)
        recorder, now_ns = self._recorder, self.get_clock().now().nanoseconds
        if recorder is None:
            return
        self._taken.sent()
        if not now_ns:
            # Simulated time has not begun: what is latched came before its first tick.
            if len(self._early) < EARLY_LIMIT:
                self._early.append((tap, message))
            return
        for early_tap, early_message in self._early:
            recorder.put(early_tap, now_ns, early_message)
        self._early.clear()
        recorder.put(tap, now_ns, message)

    def _on_record(self, request: Any, response: Any) -> Any:
        response.success = True
        try:
            if request.data and not self._is_recording():
                self.stop()
                self._start()
            elif not request.data:
                self.stop()
        except (BagError, BagWriteError) as error:
            response.success = False
            response.message = str(error)
            return response
        response.message = f"{self._state_text()}: {self.bag}"
        self.report()
        return response

    def _state_text(self) -> str:
        progress = self.progress
        return progress.state.value if progress is not None else "idle"

    def _status(self) -> DiagnosticStatus:
        self._count_losses()
        progress = self.progress
        self._report_change(progress)
        records = self._is_recording()
        values: dict[str, object] = {"state": self._state_text()}
        finding, dropped = Finding(DiagnosticStatus.OK, ""), 0
        if progress is not None:
            dropped = sum(progress.dropped.values())
            missing = self.missing_topics if records else []
            values |= _figures(progress)
            values |= {"bag": self.bag, "not published yet": " ".join(missing)}
            finding = _finding(progress, dropped)
        values["rate (Hz)"] = self._taken.close_period()["rate (Hz)"]
        return self.status_of(self._sensor.ros_name, values, [finding], self._state_text())

    def _report_change(self, progress: RecordingProgress | None) -> None:
        state = progress.state if progress is not None else None
        if progress is not None and state is not self._reported:
            if state is RecorderState.FAILED:
                self.get_logger().error(f"recording ended: {progress.problem}")
            elif state is RecorderState.FINISHED:
                self.get_logger().info(f"recorded {sum(progress.messages.values())} messages")
        self._reported = state


def _finding(progress: RecordingProgress, dropped: int) -> Finding:
    if progress.state is RecorderState.FAILED:
        return Finding(DiagnosticStatus.ERROR, progress.problem)
    # What is dropped is missing for good, however few.
    text = f"{dropped} messages dropped: {progress.problem}" if dropped else ""
    return Finding(DiagnosticStatus.WARN, text)


def _figures(progress: RecordingProgress) -> dict[str, object]:
    return {
        "messages": sum(progress.messages.values()),
        "dropped": sum(progress.dropped.values()),
        "size (MB)": f"{progress.size / MEGABYTE:.1f}",
        "duration (s)": f"{progress.duration_s:.1f}",
        "queue (MB)": f"{progress.queued_bytes / MEGABYTE:.1f}",
        **{f"messages {topic}": count for topic, count in progress.messages.items()},
        **{f"dropped {topic}": count for topic, count in progress.dropped.items()},
        "problem": progress.problem,
    }


def main() -> int:
    """Run the node as a process."""
    return run_node(Recorder)


if __name__ == "__main__":
    sys.exit(main())
