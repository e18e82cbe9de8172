"""What a collector received, as results: frames matched by their stamps, latencies, rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from cv_bridge import CvBridge
from numpy.typing import NDArray

from cmp_tactile_bringup.demo_collector import TOPICS, Arrival, Collector
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

__all__ = ["RunTimes", "gather"]


@dataclass(frozen=True)
class RunTimes:
    """asked_hz: frames per second that were asked for.  ready_s: from start to ready nodes."""

    asked_hz: float
    ready_s: float


def gather(
    collector: Collector, recording: Recording, sensor: SensorDescription, times: RunTimes
) -> DemoResults:
    """Results of the frames of the recording that came on every topic."""
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
    return DemoResults(sensor, recording, frames, _facts(came, complete, sensor, times))


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
    times: RunTimes,
) -> RunFacts:
    left, right = (_latencies(came, complete, f"{side}/grid") for side in ("left", "right"))
    arrivals = [came["wrench"][stamp].arrived_ns for stamp in complete]
    span_s = (arrivals[-1] - arrivals[0]) * 1e-9 if len(arrivals) > 1 else float("nan")
    return RunFacts(
        received={f"/{sensor.ros_name}/{topic}": len(items) for topic, items in came.items()},
        grid_latency_s=np.maximum(left, right),
        wrench_latency_s=_latencies(came, complete, "wrench"),
        asked_hz=times.asked_hz,
        rate_hz=(len(arrivals) - 1) / span_s,
        stages_s={"Start of container and nodes": times.ready_s},
        machine={**machine_facts(), **ros_facts()},
    )


def _latencies(
    came: Mapping[str, Mapping[int, Arrival]], complete: list[int], topic: str
) -> NDArray[np.float64]:
    waits = [came[topic][s].arrived_ns - came["image_raw"][s].published_ns for s in complete]
    return np.array(waits, np.float64) * 1e-9
