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
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from paper.experiment import Experiment

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
    options = _parser().parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    try:
        return _run(options, experiments)
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
    parser.add_argument("--overwrite", action="store_true", help="compute everything again")
    return parser


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        msg = f"found {number}, expected 1 or more"
        raise argparse.ArgumentTypeError(msg)
    return number


def _run(options: argparse.Namespace, experiments: Sequence[Experiment] | None) -> int:
    from rich.console import Console

    from cmp_tactile_processing.cache.files import locked

    console = Console()
    experiments = _of_the_paper() if experiments is None else experiments
    if options.list:
        for each in experiments:
            line = f"{each.key:16} {each.section:8} {each.title}"
            console.print(line, highlight=False, soft_wrap=True)
        return 0
    keys = [each.key for each in experiments]
    unknown = [key for key in options.only or [] if key not in keys]
    if unknown:
        sys.stderr.write(f"--only: found {unknown[0]}, expected any of: {', '.join(keys)}\n")
        return USAGE_ERROR
    name = f"paper{'_fast' * options.fast}"
    folder = (options.output or ROOT / "benchmark_output" / name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder / ".lock", wait_s=0.0))
        except TimeoutError:
            sys.stderr.write(f"{folder}: another run is at work there\n")
            return USAGE_ERROR
        return _run_in(folder, experiments, options, console)


def _of_the_paper() -> Sequence[Experiment]:
    """All experiments, in the order of the page."""
    from importlib import import_module

    reports = [f"{key}_report" for key in ("objects", "precision", "resolution", "reliability")]
    reports += ["speed", "balls_report", "probe_report", "grasp_report", "density"]
    return [import_module(f"paper.experiments.{name}").EXPERIMENT for name in reports]


def _run_in(
    folder: Path,
    experiments: Sequence[Experiment],
    options: argparse.Namespace,
    console: Console,
) -> int:
    from paper.experiment import Workplace
    from paper.page import RunFacts, all_claims, claims_table, page_blocks, write_page
    from paper.pool import Display, duration
    from paper.runner import Plan, compile_ahead, run_plan

    began = time.perf_counter()
    chosen = [each for each in experiments if not options.only or each.key in options.only]
    place = Workplace(folder / "kept", fast=options.fast)
    if options.overwrite:
        _forget(place.folder, chosen)
    plan = Plan(chosen, folder, place)
    cases = sum(len(cases) for cases in plan.cases.values())
    kept = cases - plan.count
    console.print(
        f"{len(chosen)} experiments, {cases} cases"
        f"{f', {kept} of them kept from an earlier run' if kept else ''}; "
        f"roughly {duration(plan.seconds / options.jobs)} on {options.jobs} cores",
        highlight=False,
    )
    if plan.count:
        console.print("compiling, once per version of the sources")
        if error := compile_ahead(place):
            # The cases will show what is wrong.
            console.print(f"not compiled ahead: {error}", markup=False)
    with Display(console, plan.seconds, plan.count + len(chosen)) as display:
        results = run_plan(plan, options.jobs, display)
    left_out = tuple(each.title for each in experiments if each not in chosen)
    facts = RunFacts(options.fast, time.perf_counter() - began, options.jobs, ROOT, left_out)
    console.print(f"took {duration(facts.wall)}")
    page = write_page(page_blocks(results, facts), folder)
    if claims := all_claims(results):
        console.print(claims_table(claims))
    failures = [(r.experiment.key, failure) for r in results for failure in r.failures]
    for key, failure in failures:
        sys.stderr.write(f"{key}: {failure.name}: {failure.error}\n{failure.trace}\n")
    console.print(f"{page}", soft_wrap=True, highlight=False)
    return 1 if failures else 0


def _forget(kept: Path, chosen: Sequence[Experiment]) -> None:
    for experiment in chosen:
        shutil.rmtree(kept / "results" / experiment.key, ignore_errors=True)
    for path in kept.glob("mechanics-*"):
        path.unlink()


if __name__ == "__main__":
    sys.exit(main())
