"""What a collector received, as results: frames matched by their stamps, latencies, rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.demo.collector import CLOCK, RESULTS, Arrival, Collector
from cmp_tactile_bringup.recordings.simulated import Recording
from cmp_tactile_bringup.report.results import DemoResults, FrameResult, RunFacts
from cmp_tactile_bringup.terminal.machine import machine_facts, ros_facts
from cmp_tactile_driver.bags.reader import BagReader, RecordedFrame
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.ros.messages.conversions import (
    force_field_from_msg,
    grid_from_msg,
    stamp_ns,
    surface_from_msg,
)
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["ReplayFacts", "gather"]

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
