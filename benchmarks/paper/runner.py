"""Runs the experiments: their cases and reports in several processes, what is kept not again."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from pathlib import Path

import joblib

from cmp_tactile_bringup.terminal.output import processor_name
from cmp_tactile_simulation.recording.run import simulator_version
from paper.blocks import Report
from paper.experiment import Case, Experiment, Workplace
from paper.pool import Display, Outcome, Task, executor, outcomes
from paper.store import Kept, Store, as_arrays, fingerprint

REPORT_SECONDS = 4.0


@dataclass(frozen=True)
class Cost:
    """What a case took, s.  kept: in an earlier run.

    steady: False where its sources were changed while it ran.
    """

    case: str
    arguments: str
    wall: float
    processor: float
    kept: bool
    steady: bool = True

    @classmethod
    def from_kept(cls, case: Case, kept: Kept, *, earlier: bool, steady: bool = True) -> Cost:
        """Of a result that was kept, in an earlier run or now."""
        arguments = ", ".join(repr(argument) for argument in case.arguments)
        return cls(case.name, arguments, kept.wall, kept.processor, earlier, steady)


@dataclass(frozen=True)
class Failure:
    """A case or a report that ended with an error."""

    name: str
    error: str
    trace: str


@dataclass
class ExperimentResult:
    """What came of an experiment; report: None where a case or the report failed."""

    experiment: Experiment
    report: Report | None = None
    costs: list[Cost] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)


class Plan:
    """What is to be done for these experiments in a folder.

    What is kept there from earlier, and still holds, is not computed again.
    Raises ValueError where an experiment has two cases of one name.
    """

    def __init__(self, experiments: Sequence[Experiment], folder: Path, place: Workplace) -> None:
        self.folder, self.place = folder, place
        place.folder.mkdir(parents=True, exist_ok=True)
        self.store = Store(place.folder / "results", fast=place.fast)
        self.results = {each.key: ExperimentResult(each) for each in experiments}
        self.cases = {each.key: tuple(each.cases(place)) for each in experiments}
        self.ahead: dict[str, list[Case]] = {each.key: [] for each in experiments}
        for key, cases in self.cases.items():
            names = [case.name for case in cases]
            for case in cases:
                if names.count(case.name) > 1:
                    msg = f"{key}: found two cases of the name {case.name!r}, expected one"
                    raise ValueError(msg)
                kept = self.store.read(key, case)
                if kept is None:
                    self.ahead[key].append(case)
                else:
                    self.results[key].costs.append(Cost.from_kept(case, kept, earlier=True))

    @property
    def count(self) -> int:
        """Cases that are to be computed."""
        return sum(len(cases) for cases in self.ahead.values())

    @property
    def seconds(self) -> float:
        """That it takes one core, roughly."""
        cases = sum(case.seconds for cases in self.ahead.values() for case in cases)
        return cases + REPORT_SECONDS * len(self.results)


def run_plan(plan: Plan, processes: int, display: Display) -> list[ExperimentResult]:
    """Compute what is missing and make all reports; errors are in the results."""
    owner: dict[str, tuple[str, Case | None]] = {}
    tasks: list[Task] = []
    missing = {key: len(cases) for key, cases in plan.ahead.items()}
    for key, cases in plan.ahead.items():
        for case in cases:
            name = f"{key}: {case.name}"
            owner[name] = key, case
            run = partial(_compute, plan.store, plan.place, key, case)
            tasks.append(Task(name, run, case.seconds, case.alone))
        owner[f"{key}: figures"] = key, None
    tasks += [_report_task(plan, key) for key, count in missing.items() if not count]
    for outcome in outcomes(tasks, processes, display):
        key, done = owner[outcome.task.name]
        result = plan.results[key]
        _take(result, outcome, done)
        if done is not None:
            missing[key] -= 1
            if not missing[key] and not result.failures:
                tasks.append(_report_task(plan, key))
    return list(plan.results.values())


def _report_task(plan: Plan, key: str) -> Task:
    figures = plan.folder / "figures" / key
    run = partial(_report, plan.store, plan.results[key].experiment, plan.cases[key], figures)
    return Task(f"{key}: figures", run, REPORT_SECONDS)


def _compute(store: Store, place: Workplace, key: str, case: Case) -> Cost:
    before = fingerprint(case, fast=place.fast)
    began, used = time.perf_counter(), time.process_time()
    arrays = as_arrays(case.work(place, *case.arguments))
    kept = Kept(arrays, time.perf_counter() - began, time.process_time() - used)
    # Sources that were changed meanwhile: nobody knows which of them were at work.
    simulator_version.cache_clear()
    steady = fingerprint(case, fast=place.fast) == before
    store.write(key, case, kept, before if steady else "")
    return Cost.from_kept(case, kept, earlier=False, steady=steady)


def _report(store: Store, experiment: Experiment, cases: Sequence[Case], figures: Path) -> Report:
    figures.mkdir(parents=True, exist_ok=True)
    for path in figures.glob("*.png"):
        path.unlink()
    results = {case.name: store.load(experiment.key, case) for case in cases}
    return experiment.report(results, figures)


def _take(result: ExperimentResult, outcome: Outcome, case: Case | None) -> None:
    if outcome.error:
        name = f"case {case.name}" if case else "report"
        result.failures.append(Failure(name, outcome.error, outcome.trace))
    elif case:
        result.costs.append(outcome.value)
    else:
        result.report = outcome.value


def compile_ahead(place: Workplace) -> str:
    """Have all that cases run compiled, if it is not yet; an error in words, or nothing.

    A process that has just compiled functions may run other copies of them than those that it
    keeps, with other last digits: so these processes compute no case.
    """
    from paper.warm_up import compile_checkers, compile_dots

    folder = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    facts = simulator_version(), sys.version, processor_name(), version("numba")
    done = folder / f"paper-{joblib.hash(facts)}"
    if done.exists():
        return ""
    pool = executor(2)
    futures = [pool.submit(compile_checkers, place), pool.submit(compile_dots, place)]
    errors = [error for future in futures if (error := future.exception())]
    pool.shutdown()
    if errors:
        return "\n".join(str(error) for error in errors)
    if folder.is_dir() and os.access(folder, os.W_OK):
        done.touch()
    return ""
