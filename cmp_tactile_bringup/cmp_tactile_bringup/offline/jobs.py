"""What is to be processed, how, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cmp_tactile_bringup.recordings.library import check_source, is_packaged, required_sensor
from cmp_tactile_driver.bags.images import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from cmp_tactile_driver.bags.storage import STORAGE_SUFFIXES
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import Finding, OutputError, Severity
from cmp_tactile_processing.sensor.description import find_sensor_description

AUTOMATIC = ("when_still", "at_start")
MAIN_SUFFIXES = (".mcap", "_wrench.csv", ".yaml")
OPTIONAL_SUFFIXES = ("_wrench.parquet", ".npz")

RECORDING_SUFFIXES = (*STORAGE_SUFFIXES, *IMAGE_SUFFIXES, *VIDEO_SUFFIXES)


@dataclass(frozen=True)
class Options:
    """What the results depend on beside recording, sensor and software.

    topic: image topic of a bag, empty for the only one.  frame_rate: of a folder of images, Hz.
    reference: what displacement counts from: "nominal", "when_still", "at_start", "first-N".
    views: with grids that are written: "both", "left", "right", "none".
    start, end: part of the recording, seconds from its first frame.
    arrays, parquet: whether NAME.npz and NAME_wrench.parquet are written, too.
    """

    topic: str = ""
    frame_rate: float = 30.0
    reference: str = "nominal"
    views: str = "both"
    start: float = 0.0
    end: float = math.inf
    arrays: bool = False
    parquet: bool = False

    @property
    def auto_reference(self) -> str:
        """When the pipeline is to take a reference by itself."""
        return self.reference if self.reference in AUTOMATIC else "never"

    @property
    def reference_frames(self) -> int:
        """How many frames of the beginning make the reference; 0: none."""
        kind, _, number = self.reference.partition("-")
        return int(number) if kind == "first" else 0

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Of the files that are written for a recording."""
        wanted = zip(OPTIONAL_SUFFIXES, (self.parquet, self.arrays), strict=True)
        return (*MAIN_SUFFIXES, *(suffix for suffix, is_wanted in wanted if is_wanted))

    def grids_of(self, views: Sequence[str]) -> tuple[str, ...]:
        """Those of a sensor's views of which grids are written."""
        return tuple(view for view in views if self.views in ("both", view))


@dataclass(frozen=True)
class Job:
    """One recording, how it is to be processed, and the folder of its results.

    All paths may be sent to another machine.  label: as the user named the recording.  name: what
    the names of the files that are made begin with.  overwrite: whether they replace others.
    sensor: file of the description, once chosen.
    """

    label: str
    source: str
    folder: str
    name: str
    options: Options
    overwrite: bool = False
    sensor: str = ""

    def __str__(self) -> str:
        return self.label

    def path(self, suffix: str) -> Path:
        """A file of the results."""
        return Path(self.folder) / f"{self.name}{suffix}"


@dataclass(frozen=True)
class Outcome:
    """frames: processed; 0 where the job has failed.

    findings: why frames could not be used, or none, which is an error, and why the results may not
    be trusted.  reference: what displacement counts from, in words.  trace: where in the code it
    has failed, in several lines.
    """

    frames: int
    findings: tuple[Finding, ...] = ()
    reference: str = ""
    trace: str = ""

    @classmethod
    def failed(cls, reason: str, trace: str = "") -> Outcome:
        """Of a job without results."""
        return cls(0, (Finding(Severity.ERROR, reason),), trace=trace)


def plan_jobs(
    sources: Sequence[Path], folder: Path, options: Options, *, overwrite: bool = False
) -> list[Job]:
    """One job per recording; one that is named twice is processed once.

    Raises OutputError where two recordings want the same files, and where results would lie among
    the files of a recording, or in the place of one.
    """
    jobs: dict[str, Job] = {}
    for source in sources:
        name = _name_of(source)
        place = source if is_packaged(source) else expanded_path(source).absolute()
        if name in jobs:
            if Path(jobs[name].source).resolve() == place.resolve():
                continue
            expected = "different names, or a separate run with another --output"
            msg = f"{source}: found the same name as {jobs[name].label}, expected {expected}"
            raise OutputError(msg)
        home = expanded_path(folder).absolute()
        job = Job(str(source), str(place), str(home), name, options, overwrite)
        if place.resolve() in (home.resolve(), job.path(".mcap").resolve()):
            msg = f"{source}: found --output {folder}, expected a folder outside the recording"
            raise OutputError(msg)
        jobs[name] = job
    return list(jobs.values())


def sensor_of(job: Job, given: str | None) -> str:
    """File of the sensor description that was given, or of the recording's own.

    Raises FrameSourceError without such a recording or where nothing names its sensor, and
    InputError without such a description.
    """
    check_source(Path(job.source))
    return str(find_sensor_description(required_sensor(Path(job.source), given)).absolute())


def _name_of(source: Path) -> str:
    if is_packaged(source):
        from cmp_tactile_simulation.scenes.file import VARIANT_MARK

        return str(source).replace(VARIANT_MARK, "_")
    place = expanded_path(source).resolve()
    known = place.is_file() and place.suffix.lower() in RECORDING_SUFFIXES
    # What else looks like a suffix may be a number: press_0.5N.
    return place.stem if known else place.name
