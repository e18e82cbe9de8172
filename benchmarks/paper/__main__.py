"""Run the paper's experiments and write their page: `make paper`, or `python3 -m paper`."""

from __future__ import annotations

import os
import shutil
import sys
import time
import traceback
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType

from tables import CommandLine

from paper.lab import Lab, Workplace
from paper.page import MET_WORDS, Page, add_claims, add_facts, add_summary

ROOT = Path(__file__).resolve().parents[2]
INTERRUPTED = 130
EXPERIMENTS = (
    "objects", "precision", "resolution", "reliability", "speed", "balls", "probe", "grasp",
    "density",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns 0 even if claims are not met, 1 if an experiment failed."""
    options = _parser().parse_args(arguments)
    modules = {key: import_module(f"paper.experiments.{key}") for key in EXPERIMENTS}
    if options.list:
        for key, module in modules.items():
            print(f"{key:14} {module.TITLE}")
        return 0
    chosen = {key: module for key, module in modules.items() if key in (options.only or modules)}
    name = f"paper{'_fast' * options.fast}"
    folder = (options.output or ROOT / "benchmark_output" / name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if options.overwrite:
        shutil.rmtree(folder / "kept", ignore_errors=True)
    lab = Lab(Workplace(folder / "kept", fast=options.fast), options.jobs)
    try:
        return run(chosen, lab, folder)
    except KeyboardInterrupt:
        sys.stderr.write("stopped: finished cases are kept, and the same command continues\n")
        return INTERRUPTED


def _parser() -> CommandLine:
    parser = CommandLine(
        "Run the paper's experiments and write a page with figures and claims. "
        "Cases of an earlier run into the same folder are not computed again."
    )
    parser.prog = "paper"
    parser.option("--fast", "fewer and smaller cases", False)
    parser.option("--only", "run only these", nargs="+", choices=EXPERIMENTS, metavar="KEY")
    parser.option("--list", "list the experiments and their keys", False)
    parser.option("--output", "folder, or benchmark_output/paper or paper_fast", type=Path)
    parser.option("--jobs", "processes", len(os.sched_getaffinity(0)))
    parser.option("--overwrite", "compute all cases again", False)
    return parser


def run(experiments: dict[str, ModuleType], lab: Lab, folder: Path) -> int:
    """Run experiments and write their page; returns 1 if one failed, and the page names it."""
    began, body, failed = time.perf_counter(), Page(folder), []
    for key, module in experiments.items():
        print(f"{key}: {module.TITLE}", flush=True)
        body.heading(module.TITLE)
        try:
            module.run(lab, body)
        except Exception as error:  # noqa: BLE001 - the other experiments are useful without it
            failed.append(key)
            traceback.print_exc()
            body.text(f"This section is incomplete: {type(error).__name__}: {error}")
    facts = {
        "Run": "fast" if lab.fast else "full",
        "Finished": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "Took": f"{(time.perf_counter() - began) / 60:.1f} min in {lab.jobs} processes",
    }
    page = Page(folder)
    page.heading("The paper's experiments on this chain", 1)
    page.prose("page", "introduction")
    add_summary(page, body.claims, fast=lab.fast)
    page.heading("How to read this page")
    page.prose("page", "methods", "departures")
    page.heading("What a simulation cannot show")
    page.prose("page", "simulated", "known")
    page.parts += body.parts
    add_claims(page, body.claims)
    add_facts(page, facts, ROOT)
    for claim in body.claims:
        print(f"{MET_WORDS[claim.met]:8} {claim.section}: {claim.what}: {claim.ours}")
    print(page.write("paper.md"))
    if failed:
        sys.stderr.write(f"failed: {', '.join(failed)}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
