"""`cmp_tactile process` and `import`: recordings through the whole chain, offline, into files."""

from __future__ import annotations

import math
import os
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cmp_tactile_bringup.commands.options import (
    Choice,
    Command,
    Number,
    RecordingSensor,
    argument,
    misuse,
    option,
)
from cmp_tactile_processing.cache.files import expanded_path

if TYPE_CHECKING:
    from rich.console import Console

    from cmp_tactile_bringup.offline.imported import Agreement
    from cmp_tactile_bringup.offline.jobs import Job, Outcome
    from cmp_tactile_bringup.offline.processor import Result
    from cmp_tactile_driver.sources.markers import MarkerRecording
    from cmp_tactile_processing.processes import OnProgress
    from cmp_tactile_processing.sensor.description import SensorDescription

MOST_REFERENCE_FRAMES = 1000
MOST_JOBS = 256
# What a process needs, twice over.
BYTES_PER_JOB = 1 << 30
SECONDS = Number(0, 1e6, "s")
_reading = partial(option, group="Input")
_results = partial(option, group="Results")
_work = partial(option, group="Work")
GEL_SENSOR = "sensor description with the gel: a file or a packaged name"


def _reference(text: str) -> str:
    kind, _, number = text.partition("-")
    if text in ("nominal", "when_still", "at_start"):
        return text
    if kind == "first" and number.isdecimal() and 1 <= int(number) <= MOST_REFERENCE_FRAMES:
        return f"first-{int(number)}"
    msg = (
        f"found {text!r}, expected nominal, when_still, at_start, or first-N with N from 1 to "
        f"{MOST_REFERENCE_FRAMES}"
    )
    raise typer.BadParameter(msg)


def _default_jobs() -> int:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(len(os.sched_getaffinity(0)) // 2, memory // BYTES_PER_JOB, MOST_JOBS))


@dataclass(frozen=True, kw_only=True)
class Process(Command):
    """Process every frame of each recording and write NAME.mcap (grids, surface, force field and
    wrench as the nodes publish them) and NAME_wrench.csv (force and moment over time). No
    running ROS is needed. The same input gives the same bytes. To continue an interrupted run, give
    the same command again: existing results are kept and reported, with exit code 1; the other
    recordings begin again.
    """

    inputs: Annotated[
        list[Path],
        argument(
            "INPUT",
            "a ROS 2 bag, a folder of images, one image, a video, or a packaged scene, such as "
            "grasp",
        ),
    ]
    output: Annotated[Path, option("folder to write", metavar="DIR")]
    sensor: RecordingSensor = None
    topic: Annotated[
        str,
        _reading(
            "image topic, if the bag has several; LEFT,RIGHT for two cameras: topics, or "
            "recordings in the folder"
        ),
    ] = ""
    frame_rate: Annotated[
        float,
        _reading(
            "frames per second of a folder of images, which has no stamps", Number(0.01, 1000, "Hz")
        ),
    ] = 30.0
    start: Annotated[float, _reading("begin this long after the first frame", SECONDS)] = 0.0
    end: Annotated[float, _reading("end this long after the first frame", SECONDS)] = math.inf
    reference: Annotated[
        str,
        _results(
            "reference of displacement and force. nominal: the description's surface; when_still "
            "or at_start: taken automatically, as by the parameter auto_reference of "
            "stereo_triangulator; first-N: mean of the first N frames, in which the gel must be "
            "at rest",
            _reference,
            metavar="WHAT",
        ),
    ] = "nominal"
    views: Annotated[
        str,
        _results(
            "views with grids in the results; both views are always processed",
            Choice(("both", "left", "right", "none")),
        ),
    ] = "both"
    parquet: Annotated[bool, _results("write NAME_wrench.parquet, too (needs pyarrow)")] = False
    arrays: Annotated[bool, _results("write NAME.npz, too")] = False
    overwrite: Annotated[bool, _results("replace existing results")] = False
    jobs: Annotated[
        int | None,
        _work(
            "recordings that are processed at the same time, each in its own process (default: "
            f"half the cores, here {_default_jobs()})",
            Number(1, MOST_JOBS, kind=int),
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        _work(
            "address of a running dask cluster, as tcp://host:8786; its machines must see the "
            "same files (needs dask.distributed)",
            metavar="ADDRESS",
        ),
    ] = None

    def run(self) -> int:
        """Process all inputs; returns 1 where one, or frames of one, could not be used."""
        from cmp_tactile_bringup.offline.jobs import Options, plan_jobs
        from cmp_tactile_bringup.offline.outputs import require_parquet
        from cmp_tactile_bringup.terminal import output_console, print_findings, print_line
        from cmp_tactile_processing.errors import warnings_of

        self.check_exclusive("jobs", "scheduler")
        if self.end < self.start:
            misuse(f"--end: found {self.end:g} s, expected --start or later")
        if self.parquet:
            require_parquet()
        options = Options(**{item.name: getattr(self, item.name) for item in fields(Options)})
        jobs = plan_jobs(self.inputs, self.output, options, overwrite=self.overwrite)
        console = output_console(stderr=True)
        if len(jobs) < len(self.inputs):
            text = "found recordings that are named twice; each is processed once"
            print_findings(warnings_of(text), console=console)
        complete = _process(jobs, self, console)
        if len(jobs) > 1:
            console.print(f"{len(jobs)} recordings, {complete.count(True)} without problems")
        written = next((path for job in jobs if (path := job.path(".mcap")).is_file()), None)
        if written is not None:
            print_line(
                console,
                f'open in Python: cmp_tactile_processing.load("{written}"), an xarray dataset',
            )
        return int(not all(complete))


def _process(jobs: list[Job], arguments: Process, console: Console) -> list[bool]:
    """Whether all of each recording could be used, printed as soon as it has ended."""
    from cmp_tactile_bringup.offline.jobs import Outcome, sensor_of
    from cmp_tactile_bringup.terminal import error_reason, shown_stages
    from cmp_tactile_processing.errors import CmpTactileError

    ready: list[Job] = []
    complete: list[bool] = []
    for job in jobs:
        try:
            ready.append(replace(job, sensor=sensor_of(job, arguments.sensor)))
        except (CmpTactileError, OSError) as error:  # noqa: PERF203  the others are processed
            complete.append(_report(console, job, Outcome.failed(error_reason(error))))
    with shown_stages() as on_stage, closing(_run(ready, arguments, on_stage)) as results:
        for job, result in results:
            if arguments.debug and result.trace:
                console.print(result.trace, markup=False, highlight=False)
            complete.append(_report(console, job, result))
            if len(jobs) > 1:
                on_stage("all recordings", len(complete) / len(jobs))
    return complete


def _run(
    jobs: list[Job], arguments: Process, on_stage: OnProgress
) -> Generator[Result, None, None]:
    from cmp_tactile_bringup.offline.processor import run_here, run_in_processes, run_on_cluster

    processes = min(arguments.jobs or _default_jobs(), len(jobs))
    if jobs and arguments.scheduler:
        return run_on_cluster(jobs, arguments.scheduler)
    if processes > 1:
        return run_in_processes(jobs, processes)
    return run_here(jobs, on_stage)


def _report(console: Console, job: Job, result: Outcome) -> bool:
    """Print the result of a job; whether all of it could be used."""
    from cmp_tactile_bringup.terminal import print_findings, print_line
    from cmp_tactile_processing.errors import errors_in

    label, errors = job.label, errors_in(result.findings)
    if result.frames:
        print_line(console, f"{label}: {result.frames} frames -> {job.path('.mcap')}")
        print_line(console, f"{label}: sensor description: {job.sensor}")
        print_line(console, f"{label}: displacement is relative to: {result.reference}")
    elif label in errors[0].text:  # most name the file that they are about
        label = ""
    print_findings(result.findings, label, console)
    return not errors


@dataclass(frozen=True, kw_only=True)
class _Import(Command):
    """Options of where results are written."""

    output: Annotated[Path, option("folder to write", metavar="DIR")]
    overwrite: Annotated[bool, option("replace existing files")] = False

    def write(self, imports: Sequence[tuple[MarkerRecording, SensorDescription]]) -> int:
        """Write the files of each recording of a sensor, and print what they are."""
        from cmp_tactile_bringup.offline.imported import plan_import, write_import
        from cmp_tactile_bringup.offline.outputs import check_results_free
        from cmp_tactile_bringup.terminal import output_console, print_findings

        console, output = output_console(), expanded_path(self.output)
        plans = [plan_import(item, output, overwrite=self.overwrite) for item, _ in imports]
        for job in plans:
            check_results_free(job)
        for (recording, sensor), job in zip(imports, plans, strict=True):
            found = write_import(recording, sensor, job)
            _report_import(recording, sensor, output, console)
            if found.agreement is not None:
                _report_agreement(recording.name, found.agreement, console)
            print_findings(found.findings, recording.name, console)
        return 0


@dataclass(frozen=True, kw_only=True)
class Tac3d(_Import):
    """Import recordings of Tac3D sensors: folders with 3D_Positions.npy, 3D_Displacements.npy and
    the other files of its recorder. Force and slip are computed from the displacements. The
    command writes:

      SERIAL.mcap        surface, force field and wrench as the nodes publish them; the sensor's
                         own forces as tac3d/wrench and tac3d/force_points
      SERIAL_wrench.csv  forces over time
      SERIAL.yaml        the description with grid, pitch and surface of this sensor

    `cmp_tactile view SERIAL.mcap` shows the result. `process`, `calibrate force` and `replay` take
    SERIAL.mcap as input.
    """

    folder: Annotated[
        Path, argument("FOLDER", "folder of one sensor, or with the folders of several")
    ]
    sensor: Annotated[str, option(GEL_SENSOR)] = "tac3d_ad2"

    def run(self) -> int:
        """Import each sensor's recording, and print how the two forces agree."""
        from cmp_tactile_driver.sources.tac3d import read_tac3d, tac3d_folders
        from cmp_tactile_processing.sensor.description import load_sensor

        sensor = load_sensor(self.sensor)
        recordings = [read_tac3d(folder) for folder in tac3d_folders(expanded_path(self.folder))]
        return self.write([(recording, recording.described(sensor)) for recording in recordings])


@dataclass(frozen=True, kw_only=True)
class Markers(_Import):
    """Import marker positions from any tracker, in the plane or in 3-D, and compute force and slip.
    FILE is one of:

      .npy  an array (frames, rows, cols, 2 or 3)
      .npz  such an array as position; optional: reference, time_s or stamp_ns
      .csv  a table with a row for each marker of each frame

    x grows with the column, y with the row. NaN is a marker that was not seen. The command writes
    NAME.mcap, NAME_wrench.csv and NAME.yaml, as `import tac3d` does.
    """

    file: Annotated[Path, argument("FILE", "an .npy, .npz or .csv file")]
    sensor: Annotated[str, option(GEL_SENSOR)]
    unit: Annotated[
        str,
        option(
            "unit of lengths in the file; px: pixels of an image of the gel from inside; the "
            "description's pitch gives the scale",
            Choice(("m", "mm", "px")),
        ),
    ] = "m"
    frame_rate: Annotated[
        float, option("frames per second, if the file has no times", Number(0.01, 10_000, "Hz"))
    ] = 30.0
    rest_frames: Annotated[
        int,
        option(
            "without a reference in the file: displacement is relative to the first N frames, in "
            "which nothing touches the gel",
            Number(1, 1000, kind=int),
        ),
    ] = 1

    def run(self) -> int:
        """Import the file."""
        from cmp_tactile_driver.sources.markers import read_markers
        from cmp_tactile_processing.sensor.description import load_sensor

        sensor, path = load_sensor(self.sensor), expanded_path(self.file)
        recording = read_markers(path, sensor.pattern, self.unit, self.frame_rate, self.rest_frames)
        return self.write([(recording, sensor)])


def _report_import(
    recording: MarkerRecording, sensor: SensorDescription, output: Path, console: Console
) -> None:
    from cmp_tactile_bringup.terminal import print_line

    frames, name = len(recording.stamp_ns), recording.name
    lost = f", {recording.lost} more were lost" if recording.lost else ""
    print_line(console, f"{name}: {frames} frames{lost} -> {output / name}.mcap")
    pattern, gel = sensor.pattern, sensor.elastomer
    shape = (
        "flat"
        if pattern.surface.type == "plane"
        else f"radius {1e3 * pattern.surface.radius:.1f} mm"
    )
    print_line(
        console, f"{name}: pitch {1e3 * pattern.pitch:.3f} mm, {shape}, E {gel.young / 1e6:.3f} MPa"
    )


def _report_agreement(name: str, found: Agreement, console: Console) -> None:
    from cmp_tactile_bringup.terminal import print_line

    along = ", ".join(
        f"{axis} {correlation:.3f} ({left:.2f} N)"
        for axis, correlation, left in zip("xyz", found.correlation, found.left, strict=True)
    )
    print_line(
        console, f"{name}: correlation with the sensor's own force (remaining difference): {along}"
    )
    print_line(console, f"{name}: the sensor's own force is {found.scale:.2f} times ours")
