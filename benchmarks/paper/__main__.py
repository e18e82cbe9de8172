"""Runs the paper's experiments and writes a page of them: `make paper`, or `python3 -m paper`."""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from paper.experiment import Experiment
    from paper.made_with import RunFacts
    from paper.runner import ExperimentResult, Plan

__all__ = ["main"]

ROOT = Path(__file__).resolve().parents[2]
USAGE_ERROR = 2


class Stopped(BaseException):
    """SIGINT or SIGTERM came."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def main(
    arguments: Sequence[str] | None = None, experiments: Sequence[Experiment] | None = None
) -> int:
    """Run the command; 0 whether or not claims are met, 1 where something failed.

    experiments: others than the paper's.
    """
    told = _parser().parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        return _run(told, experiments)
    except Stopped as stopped:
        sys.stderr.write("stopped; what is done is kept: the same command goes on from there\n")
        return 128 + stopped.number


def _stop(number: int, _frame: object) -> None:
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    raise Stopped(number)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="paper",
        description="Run the paper's experiments and write a page with figures and claims. "
        "What an earlier run into the same folder has computed is not computed again.",
    )
    parser.add_argument("--fast", action="store_true", help="fewer and smaller cases")
    parser.add_argument("--only", nargs="+", metavar="KEY", help="these experiments alone")
    parser.add_argument("--list", action="store_true", help="list the experiments")
    parser.add_argument(
        "--output", type=Path, help="folder (default benchmark_output/paper or paper_fast)"
    )
    cores = len(os.sched_getaffinity(0))
    parser.add_argument(
        "--jobs", type=_positive, default=cores, help=f"processes at once (default {cores})"
    )
    parser.add_argument("--overwrite", action="store_true", help="compute everything anew")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        msg = f"found {number}, expected 1 or more"
        raise argparse.ArgumentTypeError(msg)
    return number


def _run(told: argparse.Namespace, experiments: Sequence[Experiment] | None) -> int:
    from rich.console import Console

    from cmp_tactile_processing.cache.file_lock import FileLock

    console = Console()
    experiments = _of_the_paper() if experiments is None else experiments
    if told.list:
        for each in experiments:
            console.print(
                f"{each.key:16} {each.section:8} {each.title}", highlight=False, soft_wrap=True
            )
        return 0
    keys = [each.key for each in experiments]
    unknown = [key for key in told.only or [] if key not in keys]
    if unknown:
        sys.stderr.write(f"--only: found {unknown[0]}, expected any of: {', '.join(keys)}\n")
        return USAGE_ERROR
    chosen = [each for each in experiments if not told.only or each.key in told.only]
    left_out = tuple(each.title for each in experiments if each not in chosen)
    folder: Path = told.output or ROOT / "benchmark_output" / f"paper{'_fast' * told.fast}"
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock") as lock:
        if not lock.acquire(wait=False):
            sys.stderr.write(f"{folder}: another run is at work there\n")
            return USAGE_ERROR
        return _run_in(folder, chosen, left_out, told, console)


def _of_the_paper() -> Sequence[Experiment]:
    from paper.experiments import EXPERIMENTS

    return EXPERIMENTS


def _run_in(
    folder: Path,
    chosen: Sequence[Experiment],
    left_out: tuple[str, ...],
    told: argparse.Namespace,
    console: Console,
) -> int:
    from paper.compile_ahead import compile_ahead
    from paper.experiment import Workplace
    from paper.made_with import RunFacts
    from paper.progress import Display, duration
    from paper.runner import Plan, run_plan

    began = time.perf_counter()
    place = Workplace(folder / "kept", fast=told.fast)
    if told.overwrite:
        _forget(place.folder, chosen)
    plan = Plan(chosen, folder, place)
    _say_what_is_ahead(console, plan, told.jobs)
    if plan.ahead:
        console.print("compiling, once per version of the sources")
        if error := compile_ahead(place):
            # The cases will tell what is wrong.
            console.print(f"not compiled ahead: {error}", markup=False)
    count = len(plan.ahead) + len(chosen)
    with Display(console, plan.seconds, count, told.jobs) as display:
        results = run_plan(plan, told.jobs, display)
    facts = RunFacts(told.fast, time.perf_counter() - began, told.jobs, ROOT, left_out)
    console.print(f"took {duration(facts.wall)}")
    return _write(folder, results, facts, console)


def _forget(kept: Path, chosen: Sequence[Experiment]) -> None:
    for experiment in chosen:
        shutil.rmtree(kept / "results" / experiment.key, ignore_errors=True)
    for path in kept.glob("mechanics-*"):
        path.unlink()


def _say_what_is_ahead(console: Console, plan: Plan, jobs: int) -> None:
    from paper.progress import duration

    cases = sum(len(cases) for cases in plan.cases.values())
    kept = cases - len(plan.ahead)
    earlier = f", {kept} of them kept from an earlier run" if kept else ""
    console.print(
        f"{len(plan.results)} experiments, {cases} cases{earlier}; "
        f"roughly {duration(plan.seconds / jobs)} on {jobs} cores",
        highlight=False,
    )


def _write(
    folder: Path, results: Sequence[ExperimentResult], facts: RunFacts, console: Console
) -> int:
    from paper.claims_table import claims_table
    from paper.page import all_claims, page_blocks
    from paper.page_html import write_html
    from paper.page_markdown import write_markdown

    blocks = page_blocks(results, facts)
    page = write_html(blocks, folder / "index.html")
    write_markdown(blocks, folder / "paper.md")
    if claims := all_claims(results):
        console.print(claims_table(claims))
    failures = [(r.experiment.key, failure) for r in results for failure in r.failures]
    for key, failure in failures:
        sys.stderr.write(f"{key}: {failure.name}: {failure.error}\n{failure.trace}\n")
    console.print(f"{page}", soft_wrap=True, highlight=False)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
