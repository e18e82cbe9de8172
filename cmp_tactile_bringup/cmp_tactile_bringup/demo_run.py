"""Plays a recording through the nodes over real topics and gathers what they make of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cv_bridge import CvBridge
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool

from cmp_tactile_bringup.demo_collector import TOPICS, Arrival, Collector
from cmp_tactile_bringup.demo_container import ContainerError, ContainerProcess
from cmp_tactile_bringup.machine import machine_facts, ros_facts
from cmp_tactile_bringup.recording import Recording
from cmp_tactile_bringup.report.results import DemoResults, FrameResult, RunFacts
from cmp_tactile_processing.nodes.conversions import (
    force_field_from_msg,
    grid_from_msg,
    stamp_ns,
    surface_from_msg,
)
from cmp_tactile_processing.optics import build_views
from cmp_tactile_processing.sensor_description import SensorDescription

__all__ = ["PlayOptions", "PlayProgress", "play"]

START_TIMEOUT_S = 120.0
# Both sides of a DDS connection learn of it one after the other.
SETTLE_S = 0.5
# After the last frame was sent, nothing more is expected once no message came for so long.
QUIET_S = 1.5
FINAL_STATES = ("finished", "failed", "stopped")


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

    Raises ContainerError where the container does not start or does not finish.
    """
    told = progress or PlayProgress()
    recorded_hz = 1e9 / float(np.median(np.diff(recording.truth.stamp_ns)))
    arguments = {
        "input": str(recording.bag),
        "sensor": recording.sensor,
        "rate": f"{options.rate_hz / recorded_hz:.6f}",
        "paused": "true",
    }
    began = time.monotonic()
    with Collector(f"/{sensor.ros_name}") as collector:
        with ContainerProcess(arguments, options.log) as container:
            remote = _ReplayRemote(collector)
            container.wait_for(
                lambda: collector.connected() and remote.ready(), START_TIMEOUT_S, "start of nodes"
            )
            time.sleep(SETTLE_S)
            ready_s = time.monotonic() - began
            told.on_ready()
            remote.resume()
            expected = len(recording.truth.stamp_ns)
            ending = _Ending(collector, remote, expected, told.on_frames)
            limit_s = START_TIMEOUT_S + 5 * expected / options.rate_hz
            container.wait_for(ending, limit_s, "end of the replay")
        if container.exit_code != 0:
            msg = f"the container ended with code {container.exit_code}, expected 0"
            raise ContainerError(f"{msg}; see {options.log}")
        return _gather(collector, recording, sensor, ready_s)


class _ReplayRemote:
    """Talks to the replay node of the container."""

    def __init__(self, collector: Collector) -> None:
        self._client = collector.node.create_client(SetBool, "replay/pause")
        self.state = ""
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        collector.node.create_subscription(
            DiagnosticStatus, "replay/status", self._on_status, latched
        )

    def ready(self) -> bool:
        """Whether the replay node answers."""
        return bool(self._client.service_is_ready())

    def resume(self) -> None:
        """Let it play."""
        self._client.call_async(SetBool.Request(data=False))

    def _on_status(self, status: DiagnosticStatus) -> None:
        self.state = next((item.value for item in status.values if item.key == "state"), "")


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
        self._expected = expected * len(TOPICS)
        self._on_frames = on_frames
        self._count = 0
        self._last_change = time.monotonic()

    def __call__(self) -> bool:
        self._on_frames(self._collector.count("wrench"))
        count = sum(self._collector.count(topic) for topic in TOPICS)
        if count != self._count:
            self._count, self._last_change = count, time.monotonic()
        quiet = time.monotonic() - self._last_change > QUIET_S
        return self._remote.state in FINAL_STATES and (count >= self._expected or quiet)


def _gather(
    collector: Collector, recording: Recording, sensor: SensorDescription, ready_s: float
) -> DemoResults:
    wanted = {int(stamp): index for index, stamp in enumerate(recording.truth.stamp_ns)}
    came: dict[str, dict[int, Arrival]] = {}
    for topic in TOPICS:
        by_stamp = {stamp_ns(item.message.header.stamp): item for item in collector.arrivals(topic)}
        came[topic] = {stamp: by_stamp[stamp] for stamp in sorted(by_stamp) if stamp in wanted}
    complete = sorted(set.intersection(*(set(items) for items in came.values())))
    frames = tuple(
        _frame_result(
            wanted[stamp], {topic: came[topic][stamp].message for topic in TOPICS}, sensor
        )
        for stamp in complete
    )
    return DemoResults(sensor, recording, frames, _facts(came, complete, sensor, ready_s))


def _frame_result(
    index: int, messages: Mapping[str, Any], sensor: SensorDescription
) -> FrameResult:
    shape, views = sensor.pattern.shape, build_views(sensor)
    return FrameResult(
        index=index,
        stamp_ns=stamp_ns(messages["image_raw"].header.stamp),
        image=CvBridge().imgmsg_to_cv2(messages["image_raw"], "mono8"),
        left=grid_from_msg(messages["left/grid"], shape, views["left"].placement),
        right=grid_from_msg(messages["right/grid"], shape, views["right"].placement),
        surface=surface_from_msg(messages["surface"], shape),
        force=force_field_from_msg(messages["force_field"]),
    )


def _facts(
    came: Mapping[str, Mapping[int, Arrival]],
    complete: list[int],
    sensor: SensorDescription,
    ready_s: float,
) -> RunFacts:
    left, right = (_latencies(came, complete, f"{side}/grid") for side in ("left", "right"))
    arrivals = [came["wrench"][stamp].arrived_ns for stamp in complete]
    span_s = (arrivals[-1] - arrivals[0]) * 1e-9 if len(arrivals) > 1 else float("nan")
    return RunFacts(
        received={f"/{sensor.ros_name}/{topic}": len(items) for topic, items in came.items()},
        grid_latency_s=np.maximum(left, right),
        wrench_latency_s=_latencies(came, complete, "wrench"),
        rate_hz=(len(arrivals) - 1) / span_s,
        stages_s={"Start of container and nodes": ready_s},
        machine={**machine_facts(), **ros_facts()},
    )


def _latencies(
    came: Mapping[str, Mapping[int, Arrival]], complete: list[int], topic: str
) -> NDArray[np.float64]:
    waits = [came[topic][s].arrived_ns - came["image_raw"][s].published_ns for s in complete]
    return np.array(waits, np.float64) * 1e-9
