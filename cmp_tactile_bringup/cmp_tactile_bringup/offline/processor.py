"""Recordings of any kind (bag, images, video) through the pipeline to files, several at once.

Compiled functions give the same bits in every process that takes them from numba's cache.  A
process that has just compiled functions with fast mathematics may run other copies of them than
those that it caches, and its results differ in the seventh digit from those of all processes that
come after it.  So compiling is left to a process of its own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.offline.jobs import Job, Outcome
from cmp_tactile_bringup.offline.outputs import result_files, whole_results
from cmp_tactile_bringup.offline.pools import connected, in_processes, on_cluster
from cmp_tactile_bringup.recordings import results
from cmp_tactile_bringup.recordings.library import recorded_source
from cmp_tactile_bringup.terminal import error_reason, processor_name
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.recording import Recording, frames_within, open_recording_of
from cmp_tactile_driver.bags.timeline import TimeSpan
from cmp_tactile_driver.sources.frames import RepeatedPictures
from cmp_tactile_processing.cache.compiled import COMPILING, compiled_digest
from cmp_tactile_processing.cache.files import NO_ROOM, digest, locked, partial_folder
from cmp_tactile_processing.errors import (
    CmpTactileError,
    Finding,
    OutputError,
    Severity,
    warnings_of,
)
from cmp_tactile_processing.image.light_bands import LightBands, flicker_report
from cmp_tactile_processing.measured import NS_PER_S
from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
from cmp_tactile_processing.processes import OnProgress, no_progress, python_command
from cmp_tactile_processing.ros import diagnostics
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import implausible_ray_gap

NOMINAL = "nominal surface of the sensor description"
AS_RECORDED = "reference of the recorded surfaces; without images there are no grids"
# Of all frames, what may be missing without a word.
MISSING_SHARE = 0.1
TOO_FEW = "too few frames to say whether the gel is still"
Result = tuple[Job, Outcome]
LOCK_WAIT_S = 1.0
FRAMES_BETWEEN_REPORTS = 10
SHORTEST_S = 1e-3
"""Length of a recording of one image."""


class Processor:
    """Processes one recording, from its first frame and with nothing known of another one."""

    def __init__(self, job: Job) -> None:
        """Raises InputError for the sensor, FrameSourceError and FrameError for the rest."""
        self._job, self._options = job, job.options
        self._sensor = SensorDescription.load(Path(job.sensor))
        self._span = TimeSpan(job.options.start, job.options.end)
        self._recording: Recording = open_recording_of(
            self._sensor,
            Path(job.source),
            topic=job.options.topic,
            frame_rate=job.options.frame_rate,
        )
        # Up to the first good frame, before any work is done for the others.
        next(self._recording.frames(), None)

    def run(self, folder: Path, on_share: Callable[[float], None]) -> Outcome:
        """Process every frame and write the files into a folder.

        on_share: called now and then with the share of the time that is done, and at the end.
        Raises FrameSourceError where no frame can be used, CalibrationError where the frames
        that should give the reference cannot.
        """
        encoded = bool(self._recording.codec)
        pipeline = Pipeline(self._sensor, self._options.auto_reference, encoded=encoded)
        self._take_reference(pipeline)
        watch, faults = _Doubts(self._sensor, self._recording), _FrameFaults()
        count, is_surface = 0, False
        begin_s = self._options.start
        length_s = max(min(self._options.end, self._recording.duration) - begin_s, SHORTEST_S)
        shutil.copyfile(self._job.sensor, folder / f"{self._job.name}.yaml")
        with result_files(folder, self._job, self._sensor) as append:
            for frame in frames_within(self._recording, self._span):
                fault = faults.add(frame)
                if diagnostics.Stamp.BACK.value in fault:
                    # As the nodes do: what came before may be another recording.
                    pipeline.reset()
                result = pipeline.process(frame.content, frame.stamp_ns)
                watch.add(frame, result)
                append(frame, result, fault)
                count, is_surface = count + 1, frame.is_surface
                if not count % FRAMES_BETWEEN_REPORTS:
                    on_share((frame.time_s - begin_s) / length_s)
        on_share(1.0)
        doubts = warnings_of(
            *faults.doubts,
            self._doubt_of_reference(pipeline),
            self._doubt_of_codec(),
            pipeline.pattern_doubt,
            self._sensor.size_doubt,
            self._doubt_of_assumed(),
        )
        lost = Finding(Severity.ERROR, self._recording.health.summary)
        return Outcome(
            frames=count,
            findings=(lost, *watch.findings, *doubts),
            reference=pipeline.reference_note or (AS_RECORDED if is_surface else NOMINAL),
        )

    def _doubt_of_codec(self) -> str:
        codec = self._recording.codec
        if not codec:
            return ""
        return (
            f"the video is encoded as {codec.lower()}, which leaves out small movements: wider "
            "error bars; record a bag, or images"
        )

    def _doubt_of_assumed(self) -> str:
        assumed = ", ".join(self._sensor.uncertainty.assumed)
        return f"assumed, not measured: {assumed}" if assumed else ""

    def _doubt_of_reference(self, pipeline: Pipeline) -> str:
        if self._options.auto_reference == "never" or pipeline.reference_note:
            return pipeline.reference_doubt
        return f"no reference was taken: {pipeline.reference_doubt or TOO_FEW}"

    def _take_reference(self, pipeline: Pipeline) -> None:
        wanted = self._options.reference_frames
        if not wanted:
            return
        frames = list(islice(frames_within(self._recording, self._span), wanted))
        pipeline.set_reference([frame.content for frame in frames], frames[-1].stamp_ns)
        # The recording is then gone through from its beginning, as if they had been others.
        pipeline.reset()


class _Doubts:
    """Collects why the results may not be trusted: mostly another sensor's description."""

    def __init__(self, sensor: SensorDescription, recording: Recording) -> None:
        self._sensor = sensor
        self._calibration = recording.calibration_mismatch(sensor)
        self._recording = recording
        self._faults, self._flags = results.GridFaults(), results.ForceFlags()
        self._gaps, self._last_gap = 0, ""
        self._first: RecordedFrame | None = None

    def add(self, frame: RecordedFrame, result: PipelineResult) -> None:
        self._first = self._first or frame
        surface = result.surface
        gap = implausible_ray_gap(surface.ray_gap, surface.status, self._sensor.name)
        self._gaps, self._last_gap = self._gaps + bool(gap), gap or self._last_gap
        self._faults.add({"left": result.left, "right": result.right})
        self._flags.add(result.force)

    @property
    def findings(self) -> Iterator[Finding]:
        if self._faults.in_all and self._first and not self._first.is_surface:
            from cmp_tactile_bringup.recordings.misfit import description_misfits

            yield from warnings_of(*description_misfits(self._sensor, self._first.image))
        gaps = f"in {self._gaps} frames: {self._last_gap}" if self._gaps else ""
        yield from warnings_of(self._calibration, self._recording.gaps, gaps)
        yield from self._faults.findings
        yield from self._flags.findings


class _FrameFaults:
    """Counts the frames of a recording with stamps out of order, as the nodes do, or old pictures.

    An old picture is that of the frame before, equal to the bit.
    """

    def __init__(self) -> None:
        self._watch, self._pictures = diagnostics.StampWatch(), RepeatedPictures()
        self._frames, self._last_ns, self._longest_ns = 0, 0, 0
        self._repeated = self._most_in_a_row = 0
        self._bands, self._losses = LightBands(1), list[float]()

    def add(self, frame: RecordedFrame) -> str:
        """What is wrong: "back", "repeated", "zero" or "gap" of the stamp, "old_picture"; or ""."""
        self._frames += 1
        return " ".join(filter(None, (self._stamp_fault(frame), self._picture_fault(frame))))

    def _picture_fault(self, frame: RecordedFrame) -> str:
        if frame.is_surface:
            return ""
        self._add_light(frame.image)
        in_a_row = self._pictures.add(frame.image)
        self._repeated += in_a_row > 1
        self._most_in_a_row = max(self._most_in_a_row, in_a_row)
        return results.OLD_PICTURE if in_a_row > 1 else ""

    def _add_light(self, image: NDArray[np.uint8]) -> None:
        """Compare the light with that of the frame before."""
        if len(self._bands.changing) == len(image):
            self._bands.add(image)
            self._losses.append(self._bands.loss)
        self._bands = LightBands(len(image))
        self._bands.add(image)

    def _stamp_fault(self, frame: RecordedFrame) -> str:
        passed = frame.stamp_ns - self._last_ns
        self._last_ns = frame.stamp_ns or self._last_ns
        if not frame.time_ns and not frame.stamp_ns:
            return ""  # the first of images that have no stamps, and are given some
        missing = self._watch.missing
        kind = self._watch.take(frame.stamp_ns)
        if self._watch.missing > missing:
            self._longest_ns = max(self._longest_ns, passed)
            return "gap"
        return "" if kind is diagnostics.Stamp.LATER else kind.value

    @property
    def doubts(self) -> Iterator[str]:
        """A line for each kind of fault, and one for gaps that are worth it."""
        if self._repeated:
            yield (
                f"in {self._repeated} of {self._frames} frames the picture is that of the frame "
                f"before (the same up to {self._most_in_a_row} times in a row): not usable; had "
                "the camera stopped?"
            )
        # What moves in front of the camera changes rows in some frames, too.
        if flicker := flicker_report(float(np.median(self._losses or [0.0]))):
            yield flicker
        for kind, text in diagnostics.STAMP_FAULTS.items():
            if self._watch.stamps[kind]:
                yield f"{self._watch.stamps[kind]} of {self._frames} stamps {text}"
        missing = self._watch.missing
        if missing > MISSING_SHARE * (self._frames + missing):
            yield (
                f"{missing} of {self._frames + missing} frames are missing in gaps between "
                f"stamps; the longest gap is {self._longest_ns / NS_PER_S:.6g} s"
            )


def run_job(job: Job, on_stage: OnProgress) -> Outcome:
    """Make the results of a job.

    Raises CmpTactileError or OSError where that is not possible; nothing new is then written.
    """
    source = recorded_source(Path(job.source), on_stage)
    with whole_results(job) as folder:
        processor = Processor(replace(job, source=str(source)))
        compile_elsewhere(Path(job.sensor), on_stage)
        try:
            return processor.run(folder, partial(on_stage, job.label))
        except OSError as error:
            # An open file does not say which it is.
            if error.filename is not None or error.errno in NO_ROOM:
                raise
            msg = f"{job.label} or {job.folder}: {error.strerror or error}"
            raise OutputError(msg) from error


def run_guarded(job: Job, on_stage: OnProgress = no_progress) -> Outcome:
    """As `run_job`; no error of the job leaves this."""
    try:
        return run_job(job, on_stage)
    except Exception as error:  # noqa: BLE001  the others are to be processed all the same
        line = error_reason(error, "; --debug shows where")
        return Outcome.failed(line, traceback.format_exc())


def compile_elsewhere(sensor: Path, on_stage: OnProgress) -> None:
    """Have all that the pipeline of a sensor runs compiled by another process, if it is not yet.

    Raises OutputError where that process fails.
    """
    # What numba compiles again for: sources, Python, type of processor.
    facts = f"{compiled_digest()}\0{sys.version}\0{processor_name()}\0{version('numba')}"
    done = Path(os.environ["NUMBA_CACHE_DIR"], f"pipeline-{digest(facts)[:16]}")
    if done.exists():
        return
    with ExitStack() as until_compiled:
        try:
            done.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            until_compiled.enter_context(locked(done.with_suffix(".lock")))
        except OSError:
            return  # nothing is kept: numba says so itself
        if not done.exists():
            on_stage(COMPILING, 0.0)
            command = python_command("cmp_tactile_processing.prepare", str(sensor))
            found = subprocess.run(command, capture_output=True, text=True, check=False)
            if found.returncode:
                msg = f"{sensor}: the pipeline cannot be built: {found.stderr[-1000:]}"
                raise OutputError(msg)
            done.touch()


def run_here(jobs: Sequence[Job], on_stage: OnProgress) -> Generator[Result, None, None]:
    """Run the jobs in this process."""
    for job in jobs:
        yield job, run_guarded(job, on_stage)


def run_in_processes(jobs: Sequence[Job], processes: int) -> Generator[Result, None, None]:
    """Run the jobs in so many processes; if one of them dies, those not finished have failed."""
    left = list(jobs)
    try:
        for job, result in in_processes(jobs, run_guarded, processes):
            if not isinstance(result, CmpTactileError):
                left.remove(job)
            yield job, _outcome(result)
    finally:
        # A process that is killed leaves its own; what another run writes stays.
        for job in left:
            with suppress(OSError), partial_folder(job.path(""), LOCK_WAIT_S):
                pass


def _outcome(result: Outcome | CmpTactileError) -> Outcome:
    return Outcome.failed(str(result)) if isinstance(result, CmpTactileError) else result


def run_on_cluster(jobs: Sequence[Job], address: str) -> Generator[Result, None, None]:
    """Run the jobs on the workers of the dask scheduler at an address.

    Its workers need this software and, under the same paths, the recordings, the sensor
    description and the folder of the results.
    Raises CmpTactileError without a scheduler or worker.
    """
    with connected(address) as client:
        for job in jobs:
            Path(job.folder).mkdir(parents=True, exist_ok=True)
        for job, result in on_cluster(jobs, _run_on_worker, client):
            yield job, _outcome(result)


def _run_on_worker(job: Job) -> Outcome:
    # It was made by who sent the job; results written elsewhere would never be found.
    if not Path(job.folder).is_dir():
        expected = "expected a file system that all machines share, with the same paths"
        return Outcome.failed(f"{job.folder}: found no such folder on a worker, {expected}")
    return run_guarded(job)
