"""Processes that do tasks: one that dies, turns, and who may run beside whom."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from paper.crew import Crew, Outcome, Task


class _Heard:
    """Remembers what it is told."""

    def __init__(self) -> None:
        self.told: list[str] = []

    def begun(self, task: Task) -> None:
        self.told.append(f"{task.name} begun")

    def put_back(self, task: Task) -> None:
        self.told.append(f"{task.name} put back")

    def ended(self, outcome: Outcome) -> None:
        self.told.append(f"{outcome.task.name} ended")

    def tick(self) -> None:
        pass


@pytest.fixture
def trial(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(Path(__file__).parent / "trial")
    import paper_trial

    return paper_trial


def _run(tasks: list[Task], processes: int = 2) -> tuple[dict[str, Outcome], list[str]]:
    heard = _Heard()
    with Crew(processes, heard) as crew:
        crew.add(tasks)
        return {outcome.task.name: outcome for outcome in crew.outcomes()}, heard.told


def _task(name: str, run: Callable[..., Any], *arguments: object, **more: Any) -> Task:
    return Task(name, partial(run, *arguments), **more)


def test_the_longest_goes_first_and_every_process_has_one_thread(trial: Any) -> None:
    tasks = [
        _task("short", trial.answer, 3, seconds=1.0),
        _task("long", trial.threads, seconds=9.0),
    ]
    outcomes, told = _run(tasks, processes=1)
    assert outcomes["short"].value == 3
    assert outcomes["long"].value == ("1", 1)
    assert told == ["long begun", "long ended", "short begun", "short ended"]


def test_a_killed_process_is_told_of_and_the_others_go_on(trial: Any) -> None:
    tasks = [
        _task("dies", trial.dies, seconds=9.0),
        _task("fails", trial.fails, seconds=8.0),
        _task("lives", trial.answer, 1),
    ]
    outcomes, _ = _run(tasks, processes=1)
    assert outcomes["dies"].error == "its process was ended by SIGKILL; was there enough memory?"
    assert outcomes["fails"].error == "RuntimeError: no <luck> | here"
    assert "in fails" in outcomes["fails"].trace
    assert (outcomes["lives"].value, outcomes["lives"].error) == (1, "")


def test_who_looks_at_the_time_runs_alone(trial: Any) -> None:
    tasks = [
        _task("alone", trial.span, 0.1, seconds=99.0, alone=True),
        _task("one", trial.span, 0.3),
        _task("other", trial.span, 0.3),
    ]
    outcomes, _ = _run(tasks)
    began, ended = outcomes["alone"].value
    for name in ("one", "other"):
        other_began, other_ended = outcomes[name].value
        assert other_ended <= began or ended <= other_began


def test_a_task_steps_back_for_another_while_one_is_at_what_it_needs(
    trial: Any, tmp_path: Path
) -> None:
    """Nobody waits while there is other work; afterwards it is waited for, and both get it."""
    tasks = [
        _task("first", trial.needs_turn, str(tmp_path), "first", seconds=9.0),
        _task("second", trial.needs_turn, str(tmp_path), "second", seconds=8.0),
        _task("between", trial.answer, 1, seconds=1.0),
    ]
    outcomes, told = _run(tasks)
    assert not any(outcome.error for outcome in outcomes.values())
    log = [line.split(" ", 1)[1] for line in (tmp_path / "log").read_text().splitlines()]
    # The one at work and the one put back are two processes: which line is first is chance.
    assert sorted(log[:2]) == ["at work", "put back"]
    assert log.count("at work") == 2
    assert log[-1] == "at work"
    late = next(line.split()[0] for line in told if line.endswith("put back"))
    assert told.index("between begun") > told.index(f"{late} put back")
