"""Runs the experiments: their cases and reports in several processes, what is kept not again."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from cmp_tactile_simulation.recording.output_folder import simulator_version
from paper.crew import Crew, Listener, Outcome, Task
from paper.experiment import Case, Experiment, Report, Workplace
from paper.store import Kept, Store, as_arrays, fingerprint

__all__ = ["Cost", "ExperimentResult", "Failure", "Plan", "run_plan"]

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


@dataclass(frozen=True)
class _Ahead:
    """A case that is to be computed, and the fingerprint that its result should get."""

    experiment: Experiment
    case: Case
    fingerprint: str


class Plan:
    """What is to be done for these experiments in a folder.

    What is kept there from earlier, and still holds, is not computed again.
    Raises ValueError where an experiment has two cases of one name.
    """

    def __init__(self, experiments: Sequence[Experiment], folder: Path, place: Workplace) -> None:
        self.folder, self.place = folder, place
        place.folder.mkdir(parents=True, exist_ok=True)
        self.store = Store(place.folder / "results", fast=place.fast)
        self.results = [ExperimentResult(experiment) for experiment in experiments]
        self.cases = {each.key: tuple(each.cases(place)) for each in experiments}
        self.ahead: list[_Ahead] = []
        for result in self.results:
            for case in self.cases[result.experiment.key]:
                self._look(result, case)

    @property
    def seconds(self) -> float:
        """That it takes one core, roughly."""
        cases = sum(each.case.seconds for each in self.ahead)
        return cases + REPORT_SECONDS * len(self.results)

    def _look(self, result: ExperimentResult, case: Case) -> None:
        key = result.experiment.key
        if sum(each.name == case.name for each in self.cases[key]) > 1:
            msg = f"{key}: found two cases of the name {case.name!r}, expected different names"
            raise ValueError(msg)
        kept = self.store.read(key, case)
        if kept is None:
            found = fingerprint(case, fast=self.place.fast)
            self.ahead.append(_Ahead(result.experiment, case, found))
        else:
            result.costs.append(_cost(case, kept, kept_from_earlier=True))


def run_plan(plan: Plan, processes: int, listener: Listener) -> list[ExperimentResult]:
    """Compute what is missing and make all reports; errors are in the results."""
    results = {result.experiment.key: result for result in plan.results}
    missing = {key: [a for a in plan.ahead if a.experiment.key == key] for key in results}
    what: dict[str, _Ahead | Experiment] = {}
    with Crew(processes, listener) as crew:
        crew.add([_case_task(plan, ahead, what) for ahead in plan.ahead])
        complete = [
            result.experiment for result in plan.results if not missing[result.experiment.key]
        ]
        crew.add([_report_task(plan, experiment, what) for experiment in complete])
        for outcome in crew.outcomes():
            done = what[outcome.task.name]
            if isinstance(done, Experiment):
                _take_report(results[done.key], outcome)
                continue
            key = done.experiment.key
            missing[key].remove(done)
            _take_case(results[key], done, outcome)
            if not missing[key] and not results[key].failures:
                crew.add([_report_task(plan, done.experiment, what)])
    return plan.results


def _case_task(plan: Plan, ahead: _Ahead, what: dict[str, _Ahead | Experiment]) -> Task:
    name = f"{ahead.experiment.key}: {ahead.case.name}"
    what[name] = ahead
    run = partial(_compute, plan.store, plan.place, ahead)
    return Task(name, run, ahead.case.seconds, ahead.case.alone)


def _report_task(plan: Plan, experiment: Experiment, what: dict[str, _Ahead | Experiment]) -> Task:
    name = f"{experiment.key}: figures"
    what[name] = experiment
    figures = plan.folder / "figures" / experiment.key
    cases = plan.cases[experiment.key]
    return Task(name, partial(_report, plan.store, experiment, cases, figures), REPORT_SECONDS)


def _compute(store: Store, place: Workplace, ahead: _Ahead, patient: bool) -> Cost:
    case = ahead.case
    began, used = time.perf_counter(), time.process_time()
    at = Workplace(place.folder, place.fast, patient)
    arrays = as_arrays(case.work(at, *case.arguments))
    kept = Kept(arrays, time.perf_counter() - began, time.process_time() - used)
    # Sources that were changed meanwhile: nobody knows which of them were at work.
    simulator_version.cache_clear()
    steady = fingerprint(case, fast=place.fast) == ahead.fingerprint
    store.write(ahead.experiment.key, case, kept, ahead.fingerprint if steady else "")
    return _cost(case, kept, steady=steady)


def _report(
    store: Store, experiment: Experiment, cases: Sequence[Case], figures: Path, _patient: bool
) -> Report:
    figures.mkdir(parents=True, exist_ok=True)
    for path in figures.glob("*.png"):
        path.unlink()
    results = {case.name: store.load(experiment.key, case).arrays for case in cases}
    return experiment.report(results, figures)


def _take_case(result: ExperimentResult, done: _Ahead, outcome: Outcome) -> None:
    if outcome.error:
        result.failures.append(Failure(f"case {done.case.name}", outcome.error, outcome.trace))
    else:
        result.costs.append(outcome.value)


def _take_report(result: ExperimentResult, outcome: Outcome) -> None:
    if outcome.error:
        result.failures.append(Failure("report", outcome.error, outcome.trace))
    else:
        result.report = outcome.value


def _cost(case: Case, kept: Kept, *, kept_from_earlier: bool = False, steady: bool = True) -> Cost:
    told = ", ".join(repr(argument) for argument in case.arguments)
    return Cost(case.name, told, kept.wall, kept.processor, kept_from_earlier, steady)
