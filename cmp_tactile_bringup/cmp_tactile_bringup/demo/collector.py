"""What a sensor's nodes publish, as any other process on the network would see it.

Frames are matched by their stamps, with latencies and rate.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from cmp_tactile_bringup.recordings.simulated import Recording
from cmp_tactile_bringup.report.results import DemoResults, FrameResult, RunFacts
from cmp_tactile_bringup.terminal.machine import machine_facts, ros_facts
from cmp_tactile_driver.bags.reader import BagReader, RecordedFrame
from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.ros.messages.reading import (
    force_field_from_msg,
    grid_from_msg,
    stamp_ns,
    surface_from_msg,
)
from cmp_tactile_processing.ros.process import Listener
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["CLOCK", "RESULTS", "Arrival", "Collector", "ReplayFacts", "gather"]

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
        qos = QoSProfile(depth=QUEUE_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
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
