"""A recording played through the nodes, over real topics, in a process of their own.

In: a recording.
Out: what the nodes published, as any other process on the network would see it: matched by stamp,
with latencies and rate.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool

from cmp_tactile_bringup.report.results import DemoResults, FrameResult, Recording, RunFacts
from cmp_tactile_bringup.terminal import machine_facts, ros_facts
from cmp_tactile_driver.bags.reader import BagReader, RecordedFrame
from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.processes import python_command
from cmp_tactile_processing.ros.base_nodes import latched_qos
from cmp_tactile_processing.ros.messages.reading import (
    force_field_from_msg,
    grid_from_msg,
    stamp_ns,
    surface_from_msg,
)
from cmp_tactile_processing.ros.process import Listener
from cmp_tactile_processing.sensor.description import SensorDescription

RESULTS: Mapping[str, type] = {
    "left/grid": Grid,
    "right/grid": Grid,
    "surface": Surface,
    "force_field": ForceField,
    "wrench": WrenchStamped,
}
CLOCK = "/clock"
TOPICS: Mapping[str, type] = {CLOCK: Clock, **RESULTS}
QUEUE_DEPTH = 200

EXECUTABLES = "cmp_tactile_bringup.container.executables"
STOP_TIMEOUT_S = 15.0
LAST_LINES = 3
POLL_S = 0.02
# The first start after an update compiles the trackers.
START_TIMEOUT_S = 400.0
# Both sides of a DDS connection learn of it one after the other.
SETTLE_S = 0.5
# After the last frame was sent, nothing more is expected once no message came for so long.
QUIET_S = 1.5
FINAL_STATES = ("finished", "failed", "stopped")


@dataclass(frozen=True)
class Arrival:
    """A message, when it was published and when it arrived: ns since the epoch, one clock."""

    message: Any
    published_ns: int
    arrived_ns: int


class Collector(Listener):
    """Subscribes to RESULTS of one sensor and to CLOCK, on a thread of its own; a context manager.

    Not to the images: 0.8 MB each overrun the middleware's buffers between processes, and the
    repair delays whatever is sent beside them by half a second.  The replay publishes CLOCK right
    before each image, which shows when that was.

    Messages stay as the bytes that came until they are asked for, so that collecting takes little
    from those who compute.
    """

    def __init__(self, namespace: str) -> None:
        super().__init__("collector", namespace)
        self._bytes: dict[str, list[tuple[bytes, int, int]]] = {name: [] for name in TOPICS}

    def _subscribe(self) -> None:
        qos = QoSProfile(depth=QUEUE_DEPTH)
        self._subscriptions = [
            self.node.create_subscription(kind, name, self._listener(name), qos, raw=True)
            for name, kind in TOPICS.items()
        ]

    def connected(self) -> bool:
        """Whether every topic has a publisher that knows of this subscriber's existence."""
        return all(item.get_publisher_count() > 0 for item in self._subscriptions)

    def count(self, topic: str) -> int:
        """How many messages have come on a topic."""
        return len(self._bytes[topic])

    def arrivals(self, topic: str) -> list[Arrival]:
        """The messages of a topic, in the order in which they came."""
        kind = TOPICS[topic]
        return [
            Arrival(deserialize_message(data, kind), published, arrived)
            for data, published, arrived in list(self._bytes[topic])
        ]

    def _listener(self, topic: str) -> Any:
        messages = self._bytes[topic]

        def on_message(data: bytes, info: Mapping[str, int]) -> None:
            messages.append((data, info["source_timestamp"], time.time_ns()))

        return on_message


Arrivals = Mapping[str, Mapping[int, Arrival]]
"""Topic -> stamp in ns -> the message that bears it."""


@dataclass(frozen=True)
class ReplayFacts:
    """asked_hz: frames per second asked for.  ready_s: from start to ready nodes.

    frames_sent: what the replay node says it published on image_raw.
    """

    asked_hz: float
    ready_s: float
    frames_sent: int


def gather(
    collector: Collector, recording: Recording, sensor: SensorDescription, facts: ReplayFacts
) -> DemoResults:
    """Results of the frames of the recording that came on every topic of RESULTS."""
    wanted = {int(stamp): index for index, stamp in enumerate(recording.truth.stamp_ns)}
    came: dict[str, dict[int, Arrival]] = {}
    for topic in RESULTS:
        by_stamp = {stamp_ns(item.message.header.stamp): item for item in collector.arrivals(topic)}
        came[topic] = {stamp: by_stamp[stamp] for stamp in sorted(by_stamp) if stamp in wanted}
    complete = set.intersection(*(set(items) for items in came.values()))
    frames = tuple(
        _frame_result(wanted[frame.stamp_ns], frame, came, sensor)
        for frame in BagReader(recording.bag).frames()
        if frame.stamp_ns in complete
    )
    # The last tick of a time is the image's: its camera info comes first.
    sent = {stamp_ns(item.message.clock): item.published_ns for item in collector.arrivals(CLOCK)}
    return DemoResults(sensor, recording, frames, _run_facts(came, sent, sensor, facts))


def _frame_result(
    index: int, frame: RecordedFrame, came: Arrivals, sensor: SensorDescription
) -> FrameResult:
    shape, views = sensor.pattern.shape, build_views(sensor)
    messages: dict[str, Any] = {topic: came[topic][frame.stamp_ns].message for topic in RESULTS}
    return FrameResult(
        index=index,
        stamp_ns=frame.stamp_ns,
        image=frame.image,
        left=grid_from_msg(messages["left/grid"], shape, views["left"].placement),
        right=grid_from_msg(messages["right/grid"], shape, views["right"].placement),
        surface=surface_from_msg(messages["surface"], shape),
        force=force_field_from_msg(messages["force_field"]),
    )


def _run_facts(
    came: Arrivals, sent: Mapping[int, int], sensor: SensorDescription, facts: ReplayFacts
) -> RunFacts:
    arrivals = sorted(item.arrived_ns for item in came["wrench"].values())
    span_s = (arrivals[-1] - arrivals[0]) * 1e-9 if len(arrivals) > 1 else float("nan")
    received = {f"/{sensor.ros_name}/{topic}": len(items) for topic, items in came.items()}
    return RunFacts(
        frames_sent=facts.frames_sent,
        received=received,
        grid_latency_s=_latencies(came, sent, ("left/grid", "right/grid")),
        wrench_latency_s=_latencies(came, sent, ("wrench",)),
        asked_hz=facts.asked_hz,
        rate_hz=(len(arrivals) - 1) / span_s,
        stages_s={"Start of container and nodes": facts.ready_s},
        machine={**machine_facts(), **ros_facts()},
    )


def _latencies(
    came: Arrivals, sent: Mapping[int, int], topics: tuple[str, ...]
) -> NDArray[np.float64]:
    """From the publication of a frame until all these topics had it, s; one per frame."""
    stamps = set(sent).intersection(*(came[topic] for topic in topics))
    waits = [max(came[topic][s].arrived_ns for topic in topics) - sent[s] for s in sorted(stamps)]
    return np.array(waits, np.float64) * 1e-9


class ContainerProcess:
    """`standalone GRAPH NAME:=VALUE ...`; a context manager that ends it with SIGTERM.

    Its output goes to a log file.
    """

    def __init__(self, graph: str, arguments: dict[str, str], log: Path) -> None:
        given = [f"{name}:={value}" for name, value in arguments.items()]
        self._command = python_command(EXECUTABLES, "standalone", graph, *given)
        self._log = log
        self.exit_code: int | None = None

    def __enter__(self) -> ContainerProcess:
        with self._log.open("a") as log:
            # A session of its own: Ctrl-C reaches the command, which then ends the container.
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self.exit_code = self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.exit_code = self._process.wait()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until the condition holds.

        Raises CmpTactileError when the process ends before, or after `timeout_s` seconds.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._process.poll() is not None:
                msg = f"the container ended with code {self._process.returncode}: {self._tail()}"
                raise CmpTactileError(msg)
            if time.monotonic() > deadline:
                msg = (
                    f"{what}: found nothing within {timeout_s:g} s; see {self._log}: {self._tail()}"
                )
                raise CmpTactileError(msg)
            time.sleep(POLL_S)

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        errors = [line for line in lines if "error" in line.lower()]
        return " | ".join((errors or lines)[-LAST_LINES:])


@dataclass(frozen=True)
class PlayOptions:
    """rate_hz: frames per second.  log: file for what the container prints."""

    rate_hz: float
    log: Path


@dataclass(frozen=True)
class PlayProgress:
    """Called when the nodes are ready, and with the number of wrenches that have come so far."""

    on_ready: Callable[[], None] = lambda: None
    on_frames: Callable[[int], None] = lambda _: None


def play(
    recording: Recording,
    sensor: SensorDescription,
    options: PlayOptions,
    progress: PlayProgress | None = None,
) -> DemoResults:
    """Start the container, play the recording once, end the container.

    Raises CmpTactileError where the container does not start, finish or end cleanly.
    """
    with Collector(f"/{sensor.ros_name}") as collector:
        facts = run_replay(collector, recording, options, progress or PlayProgress())
        return gather(collector, recording, sensor, facts)


def run_replay(
    collector: Collector, recording: Recording, options: PlayOptions, progress: PlayProgress
) -> ReplayFacts:
    """Play the recording once into the collector.

    Raises CmpTactileError as `play` does.
    """
    stamps = recording.truth.stamp_ns
    recorded_hz = 1e9 / float(np.median(np.diff(stamps)))
    arguments = {
        "input": str(recording.bag.resolve()),
        "sensor": recording.sensor,
        "rate": f"{options.rate_hz / recorded_hz:.6f}",
        "paused": "true",
    }
    began = time.monotonic()
    with ContainerProcess("replay", arguments, options.log) as container:
        remote = _ReplayRemote(collector)
        container.wait_for(
            lambda: collector.connected() and remote.ready(), START_TIMEOUT_S, "start of the nodes"
        )
        time.sleep(SETTLE_S)
        ready_s = time.monotonic() - began
        progress.on_ready()
        remote.resume()
        ending = _Ending(collector, remote, len(stamps), progress.on_frames)
        limit_s = START_TIMEOUT_S + 5 * len(stamps) / options.rate_hz
        container.wait_for(ending, limit_s, "end of the replay")
    if container.exit_code != 0:
        msg = f"the container ended with code {container.exit_code}, expected 0; see {options.log}"
        raise CmpTactileError(msg)
    return ReplayFacts(options.rate_hz, ready_s, remote.frames_sent)


class _ReplayRemote:
    """Talks to the replay node of the container."""

    def __init__(self, collector: Collector) -> None:
        self._client = collector.node.create_client(SetBool, "replay/pause")
        self.state = ""
        self.frames_sent = 0
        collector.node.create_subscription(
            DiagnosticStatus, "replay/status", self._on_status, latched_qos()
        )

    def ready(self) -> bool:
        """Whether the replay node answers."""
        return bool(self._client.service_is_ready())

    def resume(self) -> None:
        """Let it play."""
        self._client.call_async(SetBool.Request(data=False))

    def _on_status(self, status: DiagnosticStatus) -> None:
        values = {item.key: item.value for item in status.values}
        self.state, self.frames_sent = values["state"], int(values["frames out"])


class _Ending:
    """True once the replay has ended and all has come, or nothing more comes."""

    def __init__(
        self,
        collector: Collector,
        remote: _ReplayRemote,
        expected: int,
        on_frames: Callable[[int], None],
    ) -> None:
        self._collector = collector
        self._remote = remote
        self._expected = expected * len(RESULTS)
        self._on_frames = on_frames
        self._count = 0
        self._last_change = time.monotonic()

    def __call__(self) -> bool:
        self._on_frames(self._collector.count("wrench"))
        count = sum(self._collector.count(topic) for topic in RESULTS)
        if count != self._count:
            self._count, self._last_change = count, time.monotonic()
        quiet = time.monotonic() - self._last_change > QUIET_S
        return self._remote.state in FINAL_STATES and (count >= self._expected or quiet)
