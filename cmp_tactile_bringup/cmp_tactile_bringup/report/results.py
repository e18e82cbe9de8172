"""A simulated recording with its truth, and what was measured while it was played."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings import library
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.measured import ForceField, Grid, Surface
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.recording.truth import RecordedTruth, read_truth
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.file import SCENE_FILE, SENSOR_FILE, read_scene


@dataclass(frozen=True)
class Phase:
    """A part of the recording: its name and its first frame (counted from 0)."""

    name: str
    first_frame: int


@dataclass(frozen=True)
class Recording:
    """A simulated bag and what is true of it.  sensor: file of its description."""

    bag: Path
    truth: RecordedTruth
    sensor: str
    title: str
    phases: tuple[Phase, ...]


def find_recording(
    name_or_path: str = library.DEFAULT_SCENE, progress: OnProgress | None = None
) -> Recording:
    """The recording of a packaged scene, or the one in the folder that is given, with its truth.

    Raises FrameSourceError where it is not a simulated recording, another error where a file of
    it cannot be used.
    """
    bag = library.recorded_source(Path(name_or_path), progress)
    for name in ("metadata.yaml", SCENE_FILE, SENSOR_FILE):
        if not (bag / name).is_file():
            msg = f"{bag}: found no {name}, expected a recording from `cmp_tactile simulate`"
            raise FrameSourceError(msg)
    scene = read_scene(bag / SCENE_FILE)
    return Recording(
        bag=bag,
        truth=read_truth(bag),
        sensor=str(bag / SENSOR_FILE),
        title=scene.title,
        phases=_phases(scene),
    )


def _phases(scene: Scene) -> tuple[Phase, ...]:
    starts = [0, *accumulate(phase.frames for phase in scene.motion)]
    return tuple(
        Phase(phase.name, start) for phase, start in zip(scene.motion, starts[:-1], strict=True)
    )


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

    @property
    def texts(self) -> tuple[str, ...]:
        """The four cells of the line."""
        kept = {None: "", True: "kept", False: "missed"}[self.passed]
        return self.name, self.value, self.limit, kept
