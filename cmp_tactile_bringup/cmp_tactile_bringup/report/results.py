"""What was measured while a recording was played."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.simulated import Recording
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.sensor.description import SensorDescription


@dataclass(frozen=True)
class FrameResult:
    """One frame and all that was derived from it.

    index: number of the frame in the recording, from 0.  image (H, W) uint8.
    left, right: grids that know their placement in the frame.
    """

    index: int
    stamp_ns: int
    image: NDArray[np.uint8]
    left: Grid
    right: Grid
    surface: Surface
    force: ForceField


@dataclass(frozen=True)
class RunFacts:
    """How the run went; every entry was measured or asked of the machine.

    frames_sent: published on image_raw.
    received: topic -> number of frames of the recording that came with it.
    grid_latency_s, wrench_latency_s: publication of image_raw to arrival of both grids and of the
    wrench, one per frame; empty where nothing was sent over topics.
    asked_hz, rate_hz: frames per second that were asked for, and at which wrenches came; NaN
    where nothing was sent over topics.
    stages_s: what took how long before and after the frames.
    machine: what the run was made with and on.
    """

    frames_sent: int
    received: Mapping[str, int]
    grid_latency_s: NDArray[np.float64]
    wrench_latency_s: NDArray[np.float64]
    asked_hz: float
    rate_hz: float
    stages_s: Mapping[str, float]
    machine: Mapping[str, str]


@dataclass(frozen=True)
class DemoResults:
    """A recording, the frames of it that came through every stage in order, and the run's facts."""

    sensor: SensorDescription
    recording: Recording
    frames: tuple[FrameResult, ...]
    run: RunFacts

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(n,) time of each frame since the first of the recording, s."""
        stamps = np.array([frame.stamp_ns for frame in self.frames], np.int64)
        return (stamps - self.recording.truth.stamp_ns[0]).astype(np.float64) * 1e-9


@dataclass(frozen=True)
class TableRow:
    """One line of the table; passed is None without a limit."""

    name: str
    value: str
    limit: str = ""
    passed: bool | None = None
