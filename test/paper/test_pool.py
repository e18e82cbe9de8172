"""Processes that do tasks: one that dies, and who may run beside whom."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from rich.console import Console

from paper.pool import Display, Outcome, Task, outcomes


class _Begun(Display):
    """Remembers the order."""

    def __init__(self) -> None:
        super().__init__(Console(quiet=True), 1.0, 1)
        self.order: list[str] = []

    def begun(self, task: Task) -> None:
        self.order.append(task.name)
        super().begun(task)


def _run(tasks: list[Task], processes: int = 2) -> tuple[dict[str, Outcome], list[str]]:
    with _Begun() as display:
        found = {outcome.task.name: outcome for outcome in outcomes(tasks, processes, display)}
        return found, display.order


def _task(name: str, run: Callable[..., Any], *arguments: object, **more: Any) -> Task:
    return Task(name, partial(run, *arguments), **more)


def test_the_longest_goes_first_and_every_process_has_one_thread(trial: Any) -> None:
    tasks = [
        _task("short", trial.answer, 3, seconds=1.0),
        _task("long", trial.threads, seconds=9.0),
    ]
    found, order = _run(tasks, processes=1)
    assert found["short"].value == 3
    assert found["long"].value == ("1", 1)
    assert order == ["long", "short"]


@pytest.mark.parametrize("processes", [1, 2])
def test_a_killed_process_fails_its_task_and_the_others_go_on(trial: Any, processes: int) -> None:
    tasks = [
        _task("dies", trial.dies, None, seconds=9.0),
        _task("fails", trial.fails, None, seconds=8.0),
        _task("lives", trial.answer, 1),
    ]
    found, _ = _run(tasks, processes)
    assert found["dies"].error == "its process was ended by SIGKILL; was there enough memory?"
    assert found["fails"].error == "RuntimeError: no <luck> | here"
    assert "in fails" in found["fails"].trace
    assert (found["lives"].value, found["lives"].error) == (1, "")


def test_a_task_that_measures_time_runs_alone(trial: Any) -> None:
    tasks = [
        _task("alone", trial.span, 0.1, seconds=99.0, alone=True),
        _task("one", trial.span, 0.3),
        _task("other", trial.span, 0.3),
    ]
    found, _ = _run(tasks)
    began, ended = found["alone"].value
    for name in ("one", "other"):
        other_began, other_ended = found[name].value
        assert other_ended <= began or ended <= other_began
