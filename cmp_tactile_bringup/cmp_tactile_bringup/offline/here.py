"""Jobs one after another in this process."""

from __future__ import annotations

import traceback
from collections.abc import Sequence

from cmp_tactile_bringup.offline.display import Display
from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_bringup.offline.task import Task, run_task

__all__ = ["run_here"]


def run_here(tasks: Sequence[Task], display: Display, *, debug: bool) -> list[Outcome | Exception]:
    """What came of each task, or the error that ended it.  debug: print tracebacks."""
    results: list[Outcome | Exception] = []
    for number, task in enumerate(tasks):
        try:
            results.append(run_task(task, display.listener(number)))
        except Exception as error:  # noqa: BLE001  the others are to be processed all the same
            if debug:
                traceback.print_exc()
            results.append(error)
        display.end(number, results[-1])
    return results
