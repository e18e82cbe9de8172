"""A task in another process: told as JSON there, and what came of it as JSON back."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from cmp_tactile_bringup.errors import TaskError
from cmp_tactile_bringup.offline.jobs import Job, Options, Outcome
from cmp_tactile_bringup.offline.task import Listener, Task, run_task
from cmp_tactile_bringup.terminal.output import error_line

__all__ = ["Told", "result_of", "run_remotely", "task_as_json"]

Told = Callable[[str, Any], None]
"""Takes what a task tells: "stage" with (what, share), "total" or "frames" with a number."""

SECONDS_BETWEEN = 0.2


def task_as_json(task: Task) -> str:
    """For `run_remotely`."""
    return json.dumps(asdict(task))


def run_remotely(text: str, tell: Told) -> str:
    """Run a task; for `result_of`.  No error of the task leaves this."""
    values = json.loads(text)
    task = Task(Job(**values["job"]), Options(**values["options"]), values["overwrite"])
    try:
        with _Reports(tell) as listener:
            outcome = run_task(task, listener)
    except Exception as error:  # noqa: BLE001  it is told where the task came from
        line = error_line(error, "; --debug shows where").removeprefix("error: ")
        return json.dumps({"error": line, "traceback": traceback.format_exc()})
    return json.dumps({"outcome": outcome.as_json(), "before": outcome.finished_before})


def result_of(text: str, *, debug: bool) -> Outcome | TaskError:
    """What came of a task that ran remotely.  debug: print its traceback."""
    values = json.loads(text)
    if "error" in values:
        if debug:
            sys.stderr.write(values.get("traceback", ""))
        return TaskError(values["error"])
    return Outcome.from_json(values["outcome"], finished_before=values["before"])


class _Reports:
    """Tells of frames a few times a second, not each by itself; a context manager."""

    def __init__(self, tell: Told) -> None:
        self._tell = tell
        self._frames = 0
        self._next_s = time.monotonic()

    def __enter__(self) -> Listener:
        return Listener(
            stage=lambda what, share: self._tell("stage", (what, share)),
            total=lambda frames: self._tell("total", frames),
            frame=self._count,
        )

    def __exit__(self, *error: object) -> None:
        if self._frames and error[0] is None:
            self._tell("frames", self._frames)

    def _count(self) -> None:
        self._frames += 1
        now = time.monotonic()
        if now >= self._next_s:
            self._tell("frames", self._frames)
            self._frames, self._next_s = 0, now + SECONDS_BETWEEN
