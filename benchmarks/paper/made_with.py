"""What a page was made with: sources, libraries, machine, time."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

from cmp_tactile_bringup.terminal.machine import machine_facts
from paper.experiment import Block, Table, Text
from paper.progress import duration
from paper.runner import Cost, ExperimentResult

__all__ = ["RunFacts", "commit_of", "made_with"]

LONGEST_ARGUMENTS = 160

SEEDS = (
    "Every random number comes from a fixed seed: the noise of a frame is drawn from the seed of "
    "its film and the frame's number. Seeds are among the arguments below where there are several; "
    "else they stand in the sources, and the run gives the same figures each time, but for times."
)


@dataclass(frozen=True)
class RunFacts:
    """The run that made a page.  wall s; processes: at work at once; left_out: experiments."""

    fast: bool
    wall: float
    processes: int
    root: Path
    left_out: tuple[str, ...] = ()
    when: datetime = field(default_factory=lambda: datetime.now(timezone.utc))


def made_with(results: Sequence[ExperimentResult], facts: RunFacts) -> Iterator[Block]:
    """The section of the page."""
    told = {
        "Sources": commit_of(facts.root),
        "Run": "fast" if facts.fast else "full",
        "Finished": facts.when.strftime("%Y-%m-%d %H:%M UTC"),
        "Took": f"{duration(facts.wall)}, with {_processes(facts.processes)}",
        **machine_facts(),
    }
    yield Table(("", ""), tuple(told.items()))
    changed = [
        f"{result.experiment.key}: {cost.case}"
        for result in results
        for cost in result.costs
        if not cost.steady
    ]
    if changed:
        yield Text(
            "Sources were changed while these cases ran, and so are computed anew next time: "
            f"{', '.join(changed)}."
        )
    yield Text(SEEDS)
    yield _costs(results)
    yield _cases(results)


def commit_of(root: Path) -> str:
    """The commit that is checked out there, and whether files differ from it."""
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    if commit is None:
        return "no Git checkout"
    changed = _git(root, "status", "--porcelain")
    count = len((changed or "").splitlines())
    if not count:
        return f"commit {commit}, nothing changed"
    return f"commit {commit}, and {count} file{'s' if count > 1 else ''} changed or added since"


def _git(root: Path, *command: str) -> str | None:
    try:
        found = subprocess.run(
            ("git", "-C", str(root), *command),  # noqa: S607  the user's own git
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return found.stdout.strip()


def _processes(count: int) -> str:
    if count == 1:
        return "one process of one thread"
    return f"{count} processes of one thread each"


def _costs(results: Sequence[ExperimentResult]) -> Table:
    rows = [_cost_row(result.experiment.key, result.costs) for result in results]
    rows.append(_cost_row("all", [cost for result in results for cost in result.costs]))
    head = ("Experiment", "Cases", "Of an earlier run", "Time of the cases", "Processor time")
    caption = "Times are summed over cases, of which several run at once."
    return Table(head, tuple(rows), caption)


def _cost_row(name: str, costs: Sequence[Cost]) -> tuple[str, ...]:
    return (
        name,
        f"{len(costs)}",
        f"{sum(cost.kept for cost in costs)}",
        duration(sum(cost.wall for cost in costs)),
        duration(sum(cost.processor for cost in costs)),
    )


def _cases(results: Sequence[ExperimentResult]) -> Table:
    rows = tuple(
        (f"{result.experiment.key}: {cost.case}", _short(cost.arguments), duration(cost.wall))
        for result in results
        for cost in sorted(result.costs, key=lambda cost: cost.case)
    )
    return Table(("Case", "Arguments", "Time"), rows)


def _short(text: str) -> str:
    return text if len(text) <= LONGEST_ARGUMENTS else f"{text[: LONGEST_ARGUMENTS - 3]}..."
