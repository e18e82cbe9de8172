"""One job from beginning to end, wherever it is run, with what it tells meanwhile."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from cmp_tactile_bringup.errors import OutputError
from cmp_tactile_bringup.offline.compiled import compile_elsewhere
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_bringup.offline.processor import Processor
from cmp_tactile_bringup.offline.result_files import ResultFiles
from cmp_tactile_bringup.recordings.library import recorded_source

__all__ = ["Listener", "Task", "run_task"]

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Task:
    """A job with its sensor chosen, and how it is to be done."""

    job: Job
    options: Options
    overwrite: bool = False


@dataclass(frozen=True)
class Listener:
    """What a job tells: the share of a stage before the first frame, the frames that it expects to
    process (None: unknown), each frame."""

    stage: Callable[[str, float], None] = lambda _what, _share: None
    total: Callable[[int | None], None] = lambda _frames: None
    frame: Callable[[], None] = lambda: None


def run_task(task: Task, listener: Listener) -> Outcome:
    """Make the results of a job, or find that they are made.

    Raises CmpTactileError or OSError where that is not possible; nothing new is then written.
    """
    source = recorded_source(Path(task.job.source), listener.stage)
    job, options = replace(task.job, source=str(source)), task.options
    with ResultFiles(job, options) as files:
        finished = files.finished(overwrite=task.overwrite)
        if finished is not None:
            listener.total(finished.frames)
            return finished
        processor = Processor(job, options)
        compile_elsewhere(Path(job.sensor), listener.stage)
        listener.total(_expected(processor, options))
        folder = files.begin()
        try:
            outcome = processor.run(folder, listener.frame)
            files.complete(outcome)
        except OSError as error:
            if error.filename is not None:
                raise
            # An open file does not say which it is.
            where = job.folder if error.errno in NO_ROOM else f"{job.label} or {job.folder}"
            msg = f"{where}: {error.strerror or error}"
            raise OutputError(msg) from error
    return outcome


def _expected(processor: Processor, options: Options) -> int | None:
    whole = options.start_s == 0 and options.end_s == float("inf")
    return processor.declared_frames if whole else None
