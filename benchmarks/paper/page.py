"""The page: what it says in reading order, as HTML and as Markdown; claims on a terminal."""

from __future__ import annotations

import base64
import os
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import jinja2
import rich.markup
import rich.table
from markupsafe import Markup

from cmp_tactile_bringup.terminal.output import machine_facts
from paper.blocks import Block, Claim, Figure, Table, Text, prose
from paper.pool import duration
from paper.runner import Cost, ExperimentResult

TITLE = "The paper's experiments on this chain"
# The end of a sentence, but not the full stop of "Fig. 10".
SENTENCE_END = re.compile(r"(?<=[.;])(?<!Fig\.)\s")
MET_WORDS = {True: "met", False: "not met", None: "–"}
STYLES = {True: "green", False: "bold red", None: "dim"}
VERDICTS = {"met": ' class="met"', "not met": ' class="missed"'}
CLAIM_HEAD = ("Section", "Claim", "The paper", "Here", "Met")


LONGEST_ARGUMENTS = 160


@dataclass(frozen=True)
class RunFacts:
    """The run that made a page.  wall s; processes: at work at once; left_out: experiments."""

    fast: bool
    wall: float
    processes: int
    root: Path
    left_out: tuple[str, ...] = ()
    when: datetime = field(default_factory=lambda: datetime.now(timezone.utc))


@dataclass(frozen=True)
class Heading:
    """Opens a section of the page; level 1 is the title."""

    text: str
    level: int = 2


PageBlock = Heading | Block


def page_blocks(results: Sequence[ExperimentResult], facts: RunFacts) -> list[PageBlock]:
    """The whole page."""
    return [
        Heading(TITLE, 1),
        prose("page", "introduction"),
        *_summary(results, facts),
        Heading("How to read this page"),
        *(prose("page", name) for name in ("methods", "departures")),
        Heading("What a simulation cannot show"),
        *(prose("page", name) for name in ("simulated", "known")),
        *(block for result in results for block in _section(result)),
        Heading("Claims"),
        *_claims(results),
        Heading("Made with"),
        *_made_with(results, facts),
    ]


def alternative(caption: str) -> str:
    """A caption's first sentence, for those who do not see the picture."""
    return SENTENCE_END.split(caption, maxsplit=1)[0].replace("`", "").rstrip(".;")


def all_claims(results: Sequence[ExperimentResult]) -> list[Claim]:
    """The claims of all experiments, in the order of the page."""
    return [claim for result in results if result.report for claim in result.report.claims]


def _summary(results: Sequence[ExperimentResult], facts: RunFacts) -> Iterator[PageBlock]:
    yield Heading("Summary")
    claims = all_claims(results)
    missed = [claim for claim in claims if claim.met is False]
    met = sum(claim.met is True for claim in claims)
    open_ = len(claims) - met - len(missed)
    rest = f"; {open_} of them could not be missed" if open_ else ""
    yield Text(
        f"{len(claims)} claims: {met} met, {len(missed)} not met{rest}. All are in the table of "
        "claims below; some ask the same of several methods, so that their number is no score."
    )
    if facts.fast:
        yield Text(
            "This is the fast run: fewer and smaller cases than the full one. Its figures are "
            "rougher, and a claim may come out otherwise than in the full run."
        )
    if facts.left_out:
        yield Text(f"Not asked for, and so not on this page: {', '.join(facts.left_out)}.")
    if missed:
        head = ("Not met", "The paper", "Here")
        yield Table(head, tuple((f"{c.section}: {c.what}", c.paper, c.ours) for c in missed))
    failed = [result for result in results if result.failures]
    if failed:
        titles = ", ".join(result.experiment.title for result in failed)
        yield Text(f"Missing, because something failed: {titles}. Their sections say what.")


def _section(result: ExperimentResult) -> Iterator[PageBlock]:
    experiment = result.experiment
    where = experiment.section or "Beyond the paper"
    yield Heading(f"{where}: {experiment.title}")
    if result.report is None:
        yield Text("This section is missing, because something failed:")
        errors = tuple((failure.name, failure.error) for failure in result.failures)
        yield Table(("What", "Error"), errors)
        return
    yield from result.report.blocks
    if result.report.deviations:
        head = ("Departure from the paper", "The paper", "Here", "Why")
        rows = tuple((d.what, d.paper, d.here, d.why) for d in result.report.deviations)
        yield Table(head, rows)


def _claims(results: Sequence[ExperimentResult]) -> Iterator[PageBlock]:
    rows = tuple(
        (claim.section, claim.what, claim.paper, claim.ours, MET_WORDS[claim.met])
        for claim in all_claims(results)
    )
    if not rows:
        yield Text("There are none.")
        return
    yield Table(
        CLAIM_HEAD, rows, f"{MET_WORDS[None]}: the paper states nothing that could be missed."
    )


def _made_with(results: Sequence[ExperimentResult], facts: RunFacts) -> Iterator[Block]:
    """The section of the page."""
    facts_of = {
        "Sources": commit_of(facts.root),
        "Run": "fast" if facts.fast else "full",
        "Finished": facts.when.strftime("%Y-%m-%d %H:%M UTC"),
        "Took": f"{duration(facts.wall)}, with {_processes(facts.processes)}",
        **machine_facts(),
    }
    yield Table(("", ""), tuple(facts_of.items()))
    changed = [
        f"{result.experiment.key}: {cost.case}"
        for result in results
        for cost in result.costs
        if not cost.steady
    ]
    if changed:
        yield Text(
            "Sources were changed while these cases ran, and so are computed again next time: "
            f"{', '.join(changed)}."
        )
    yield prose("page", "seeds")
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


CODE = re.compile(r"`([^`\n]+)`")
SPECIAL = re.compile(r"([\\*_\[\]<>|`])")
# At the beginning of a line these would begin a list, a heading or a quotation.
LINE_BEGIN = re.compile(r"^(\s*)([-+#]|\d+(?=[.)]))")


def write_page(blocks: Sequence[PageBlock], folder: Path) -> Path:
    """Write index.html, with every picture inside, and paper.md, which links to them."""
    filters = {
        "alternative": alternative,
        "base64": lambda path: base64.b64encode(path.read_bytes()).decode("ascii"),
        "cell": partial(_markdown, in_table=True),
        "code": lambda text: Markup(CODE.sub(r"<code>\1</code>", escape(text))),  # noqa: S704
        "inline": _markdown,
        "link": lambda path: Path(os.path.relpath(path, folder)).as_posix().replace(" ", "%20"),
        "paragraph": lambda text: LINE_BEGIN.sub(r"\1\\\2", _markdown(text)),
        "verdict": lambda text: Markup(VERDICTS.get(text, "")),  # noqa: S704
    }
    kinds = {"heading": Heading, "text": Text, "figure": Figure}
    tests: dict[str, Any] = {name: _is(kind) for name, kind in kinds.items()}
    title = next((block.text for block in blocks if isinstance(block, Heading)), "")
    for template, name in (("page.html.jinja", "index.html"), ("page.md.jinja", "paper.md")):
        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent),
            autoescape=jinja2.select_autoescape(["html.jinja"]),
            undefined=jinja2.StrictUndefined,
        )
        environment.filters |= filters
        environment.tests |= tests
        page = environment.get_template(template).render(blocks=blocks, title=title)
        (folder / name).write_text(page.rstrip("\n") + "\n", encoding="utf-8")
    return folder / "index.html"


def _is(kind: type) -> Any:
    return lambda block: isinstance(block, kind)


def _markdown(text: str, *, in_table: bool = False) -> str:
    """Escaped, but for what stands between backquotes."""
    parts = re.split(r"(`[^`\n]+`)", " ".join(text.split()))
    # A table ends its cell at any bar, also at one in code.
    parts[1::2] = [part.replace("|", r"\|") if in_table else part for part in parts[1::2]]
    parts[::2] = [SPECIAL.sub(r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def claims_table(claims: Sequence[Claim]) -> rich.table.Table:
    """For the terminal: section, claim, the paper's figure, ours, met or not."""
    table = rich.table.Table(
        title="Claims of the paper (none of them decides how the run ends)",
        title_justify="left",
        title_style="bold",
    )
    for heading in CLAIM_HEAD:
        table.add_column(heading, overflow="fold")
    for claim in claims:
        texts = (claim.section, claim.what, claim.paper, claim.ours)
        cells = [rich.markup.escape(text.replace("`", "")) for text in texts]
        table.add_row(*cells, f"[{STYLES[claim.met]}]{MET_WORDS[claim.met]}[/]")
    return table
