"""Recordings through the pipeline into files, without ROS."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from cmp_tactile_bringup.array_log import ArrayLog
from cmp_tactile_bringup.recorded_forces import COLUMNS, ForceFlags, force_arrays, table_row
from cmp_tactile_bringup.recorded_grids import GridFaults, grid_arrays
from cmp_tactile_bringup.recording import check_source, is_packaged, required_sensor
from cmp_tactile_driver.bag_reader import BagReader
from cmp_tactile_driver.calibration_check import calibration_mismatch
from cmp_tactile_driver.frame_source import ImageSize, SourceHealth, size_text
from cmp_tactile_driver.image_decoding import decode_file
from cmp_tactile_driver.image_folder import IMAGE_SUFFIXES, image_files
from cmp_tactile_driver.recorded_message import RecordedFrame
from cmp_tactile_driver.recording import Recording, open_recording
from cmp_tactile_processing.errors import CmpTactileError, FrameError
from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
from cmp_tactile_processing.ray_gap import implausible_ray_gap
from cmp_tactile_processing.sensor_library import load_sensor
from cmp_tactile_simulation.scene_library import VARIANT_MARK

__all__ = [
    "FrameFolderOptions",
    "Job",
    "Outcome",
    "OutputError",
    "RecordingProcessor",
    "choose_sensor",
    "plan_jobs",
]


class OutputError(CmpTactileError):
    """Results that cannot be written where they should go."""


@dataclass(frozen=True)
class FrameFolderOptions:
    """topic: image topic of a bag, empty for the only one.  frame_rate: of a folder, Hz."""

    topic: str = ""
    frame_rate: float = 30.0


@dataclass(frozen=True)
class Job:
    """One recording and the two files that are made from it.  label: as the user named it."""

    label: str
    source: Path
    arrays: Path
    wrench: Path


@dataclass(frozen=True)
class Outcome:
    """frames: processed.

    problem: why frames of the recording could not be used, or empty.  doubts: why the sensor
    description may be another sensor's.
    """

    frames: int
    problem: str
    doubts: tuple[str, ...] = ()


class SingleImage:
    """One image file as a recording of one frame, with stamp 0."""

    has_camera_info = False
    health = SourceHealth()

    def __init__(self, path: Path, expected_size: ImageSize) -> None:
        self._path = path
        self._expected_size = expected_size

    @property
    def name(self) -> str:
        """The file."""
        return str(self._path)

    def calibration(self) -> None:
        """None: an image alone does not tell."""

    def messages(self) -> Iterator[RecordedFrame]:
        """The image; ImageDecodingError or FrameError where it cannot be used."""
        image = decode_file(self._path)
        size = (image.shape[1], image.shape[0])
        if size != self._expected_size:
            msg = (
                f"{self._path}: found {size_text(size)}, expected {size_text(self._expected_size)}"
            )
            raise FrameError(msg)
        yield RecordedFrame(0, 0, "", image)


def plan_jobs(sources: Sequence[Path], folder: Path, *, overwrite: bool) -> list[Job]:
    """One job per recording; makes the folder.

    Raises OutputError where two recordings, or one and an older result, want the same file.
    """
    jobs: dict[Path, Job] = {}
    for source in sources:
        name = _name_of(source)
        job = Job(
            str(source), source.expanduser(), folder / f"{name}.npz", folder / f"{name}_wrench.csv"
        )
        if job.arrays in jobs:
            other = jobs[job.arrays].label
            msg = f"{source}: found the same name as {other}, expected names that differ"
            raise OutputError(msg)
        for path in (job.arrays, job.wrench):
            if path.exists() and not overwrite:
                msg = f"{path}: exists already; --overwrite replaces it"
                raise OutputError(msg)
        jobs[job.arrays] = job
    folder.mkdir(parents=True, exist_ok=True)
    return list(jobs.values())


def _name_of(source: Path) -> str:
    if is_packaged(source):
        return str(source).replace(VARIANT_MARK, "_")
    place = source.expanduser().resolve()
    return place.stem if place.suffix else place.name


def choose_sensor(job: Job, given: str | None) -> str:
    """The sensor that was given, or the recording's own.

    Raises RecordingError where there is no such recording or nothing tells its sensor.
    """
    check_source(job.source, "a ROS 2 bag, a folder of images, an image")
    return required_sensor(job.source, given)


class RecordingProcessor:
    """Processes recordings of one sensor one after another."""

    def __init__(self, sensor: str, options: FrameFolderOptions) -> None:
        """sensor: file or packaged name; DescriptionError where it cannot be used."""
        self._sensor = load_sensor(sensor)
        self._options = options
        self._pipeline = Pipeline(self._sensor)

    def count(self, job: Job) -> int | None:
        """Number of frames that the recording claims to have; None where it does not tell."""
        if job.source.suffix.lower() in IMAGE_SUFFIXES:
            return 1
        recording = self._open(job.source)
        if isinstance(recording, BagReader):
            return _count_in_metadata(job.source, recording.image_topic)
        return len(image_files(job.source))

    def process(self, job: Job, on_frame: Callable[[], None] = lambda: None) -> Outcome:
        """Process every frame and write the job's files.

        Each recording begins with the tracking state forgotten.  Raises FrameSourceError where no
        frame can be used; nothing is written then.
        """
        self._pipeline.reset()
        count = 0
        recording = self._open(job.source)
        doubts = [calibration_mismatch(recording.calibration(), self._sensor)]
        gaps, faults, flags = _RayGaps(self._sensor.name), GridFaults(), ForceFlags()
        partial = job.wrench.with_name(f".{job.wrench.name}.partial")
        try:
            with ArrayLog(job.arrays) as log, partial.open("w", newline="") as table:
                writer = csv.writer(table)
                writer.writerow(COLUMNS)
                for frame in _frames(recording):
                    result = self._pipeline.process(frame.image, frame.stamp_ns)
                    gaps.add(result)
                    faults.add({"left": result.left, "right": result.right})
                    flags.add(result.force)
                    log.append(_arrays(frame.stamp_ns, result))
                    writer.writerow(table_row(frame.stamp_ns, result.force))
                    count += 1
                    on_frame()
            partial.replace(job.wrench)
        finally:
            partial.unlink(missing_ok=True)
        doubts += [gaps.doubt, *faults.doubts, *flags.doubts]
        return Outcome(count, recording.health.summary, tuple(filter(None, doubts)))

    def _open(self, source: Path) -> Recording:
        size = (self._sensor.image.width, self._sensor.image.height)
        if source.suffix.lower() in IMAGE_SUFFIXES and not source.is_dir():
            return SingleImage(source, size)
        return open_recording(
            source,
            topic=self._options.topic,
            frame_rate=self._options.frame_rate,
            frame_id="",
            expected_size=size,
        )


class _RayGaps:
    """Counts the frames whose rays miss each other."""

    def __init__(self, sensor: str) -> None:
        self._sensor = sensor
        self._count = 0
        self._last = ""

    def add(self, result: PipelineResult) -> None:
        surface = result.surface
        doubt = implausible_ray_gap(surface.ray_gap, surface.status, self._sensor)
        self._last = doubt or self._last
        self._count += bool(doubt)

    @property
    def doubt(self) -> str:
        return f"in {self._count} frames {self._last}" if self._count else ""


def _frames(recording: Recording) -> Iterator[RecordedFrame]:
    return (item for item in recording.messages() if isinstance(item, RecordedFrame))


def _count_in_metadata(bag: Path, topic: str) -> int | None:
    try:
        text = (bag / "metadata.yaml").read_text(encoding="utf-8")
        topics: Any = yaml.safe_load(text)["rosbag2_bagfile_information"]
        for item in topics["topics_with_message_count"]:
            if item["topic_metadata"]["name"] == topic:
                return int(item["message_count"])
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
        # Only the progress bar wants it.
        return None
    return None


def _arrays(stamp_ns: int, result: PipelineResult) -> dict[str, NDArray[Any]]:
    """What is kept of a frame; float32 keeps 1e-4 px and 1e-9 m."""
    surface = result.surface
    values: dict[str, NDArray[Any]] = {"stamp_ns": np.array(stamp_ns, np.int64)}
    for name, grid in (("left", result.left), ("right", result.right)):
        if grid is not None:
            values |= {f"{name}_{key}": array for key, array in grid_arrays(grid).items()}
    values |= {
        "reference": surface.reference,
        "position": surface.position,
        "displacement": surface.displacement,
        "status": surface.status,
        "ray_gap": surface.ray_gap,
        "row_position": surface.row_position,
        "col_position": surface.col_position,
        **force_arrays(result.force),
    }
    single = np.float32
    return {k: v.astype(single) if v.dtype == np.float64 else v for k, v in values.items()}
