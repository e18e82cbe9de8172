"""One job from beginning to end, wherever it is run, with what it reports meanwhile.

Compiled functions give the same bits in every process that takes them from numba's cache.  A
process that has just compiled functions with fast mathematics may run other copies of them than
those that it caches, and its results differ in the seventh digit from those of all processes that
come after it.  So compiling is left to a process of its own.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cmp_tactile_processing
from cmp_tactile_bringup.errors import OutputError, TaskError
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_bringup.offline.processor import Processor
from cmp_tactile_bringup.offline.result_files import ResultFiles
from cmp_tactile_bringup.recordings.library import is_packaged, recorded_source
from cmp_tactile_bringup.terminal.output import error_line, processor_name
from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_processing.cache.files import digest, locked
from cmp_tactile_processing.python_command import python_command

Report = Callable[[str, Any], None]
"""Takes what a task reports: "stage" with what is done before the first frame and its share,
"total" with the number of frames that it expects (None: unknown), "frames" with how many more were
processed."""

COMPILING = "compiling, once per version of the software"
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
SECONDS_BETWEEN_REPORTS = 0.2


@dataclass(frozen=True)
class Task:
    """A job with its sensor chosen, and how it is to be done."""

    job: Job
    options: Options
    overwrite: bool = False


def run_task(task: Task, report: Report) -> Outcome:
    """Make the results of a job, or find that they are made.

    Raises CmpTactileError or OSError where that is not possible; nothing new is then written.
    """

    def stage(what: str, share: float) -> None:
        report("stage", (what, share))

    source = recorded_source(Path(task.job.source), stage)
    job, options = replace(task.job, source=str(source)), task.options
    with ResultFiles(job, options) as files:
        finished = files.finished(overwrite=task.overwrite)
        if finished is not None:
            report("total", finished.frames)
            return finished
        processor = Processor(job, options)
        compile_elsewhere(Path(job.sensor), stage)
        report("total", processor.expected_frames)
        folder = files.begin()
        try:
            count = _FrameCount(report)
            outcome = processor.run(folder, count.add)
            count.report()
            files.complete(outcome)
        except OSError as error:
            if error.filename is not None:
                raise
            # An open file does not say which it is.
            where = job.folder if error.errno in NO_ROOM else f"{job.label} or {job.folder}"
            msg = f"{where}: {error.strerror or error}"
            raise OutputError(msg) from error
    return outcome


class _FrameCount:
    """Reports frames a few times a second, not each by itself."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._frames, self._next_s = 0, 0.0

    def add(self) -> None:
        """A frame was processed."""
        self._frames += 1
        if time.monotonic() >= self._next_s:
            self.report()

    def report(self) -> None:
        """Report those that are not reported yet."""
        if self._frames:
            self._report("frames", self._frames)
        self._frames, self._next_s = 0, time.monotonic() + SECONDS_BETWEEN_REPORTS


def run_remotely(values: dict[str, Any], report: Report) -> dict[str, Any]:
    """Run a task, given as dataclasses.asdict has it, in another process; for `result_of`.

    No error of the task leaves this.
    """
    task = Task(Job(**values["job"]), Options(**values["options"]), values["overwrite"])
    try:
        return asdict(run_task(task, report))
    except Exception as error:  # noqa: BLE001  it is reported where the task came from
        line = error_line(error, "; --debug shows where").removeprefix("error: ")
        return {"error": line, "traceback": traceback.format_exc()}


def run_with_shared_files(values: dict[str, Any], address: str, report: Report) -> dict[str, Any]:
    """As `run_remotely`, once it is sure that the worker sees the files of the task."""
    job = values["job"]
    for place in (job["source"], job["sensor"], job["folder"]):
        if not Path(place).exists() and not is_packaged(Path(place)):
            msg = (
                f"{place}: found no such file or folder on the worker {address}, expected a file "
                "system that all machines share, with the same paths"
            )
            return {"error": msg}
    return run_remotely(values, report)


def result_of(values: dict[str, Any], *, debug: bool) -> Outcome | TaskError:
    """What came of a task that ran remotely.  debug: print its traceback."""
    if "error" not in values:
        return Outcome(**values)
    if debug:
        sys.stderr.write(values.get("traceback", ""))
    return TaskError(values["error"])


def compile_elsewhere(sensor: Path, stage: Callable[[str, float], None]) -> None:
    """Have all that the pipeline of a sensor runs compiled by another process, if it is not yet.

    Raises OutputError where that process fails.
    """
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return  # nothing is kept: numba says so itself
    # What numba compiles again for: sources, Python, type of processor.
    sources = source_digest(Path(cmp_tactile_processing.__file__).parent)
    facts = f"{sources}\0{sys.version}\0{processor_name()}\0{version('numba')}"
    done = folder / f"pipeline-{digest(facts)[:16]}"
    if done.exists():
        return
    with locked(done.with_suffix(".lock")):
        if not done.exists():
            stage(COMPILING, 0.0)
            command = python_command("cmp_tactile_processing.prepare", str(sensor))
            found = subprocess.run(command, capture_output=True, text=True, check=False)
            if found.returncode:
                msg = f"{sensor}: the pipeline cannot be built: {found.stderr[-1000:]}"
                raise OutputError(msg)
            done.touch()
