"""What the page says, in reading order; page_html and page_markdown write it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from paper.experiment import Block, Claim, Table, Text
from paper.made_with import RunFacts, made_with
from paper.runner import ExperimentResult

__all__ = ["MET_WORDS", "Heading", "PageBlock", "all_claims", "alternative", "page_blocks"]

TITLE = "The paper's experiments on this chain"
# The end of a sentence, but not the full stop of "Fig. 10".
SENTENCE_END = re.compile(r"(?<=[.;])(?<!Fig\.)\s")
MET_WORDS = {True: "met", False: "not met", None: "–"}

INTRODUCTION = (
    "Sections IV and V of Continuous Marker Patterns for Representing Contact Information in "
    "Vision-based Tactile Sensor compare a continuous marker pattern (CMP, a checkerboard) with a "
    "distributed one (DMP, dots). Here each of these experiments is run on the chain of this "
    "repository, and what came out stands beside the paper's figure."
)

HOW_TO_READ = (
    (
        "CMP is this repository's tracker as it is by default. `CMP, the paper's algorithm` takes "
        "the steps of section III; what the paper does not tell of them, a filter against impulses "
        "and the place of a corner to fractions of a pixel, is this repository's. DMP methods see "
        "dots at the places of the checkers' corners, as many, on a gel that is deformed "
        "identically: the contact is solved once for all. "
        "Triangulation and force are the same for all, save that the paper's algorithm "
        "triangulates as the paper tells."
    ),
    (
        "Every section ends with a table of its departures from the paper's set-up. Settings of "
        "methods were chosen on other frames than those that they are judged on, save where a "
        "section says otherwise. Where another method than CMP does as well or better, the section "
        "says so, and a claim of the paper that did not come out here is `not met` in the table of "
        "claims. That does not mean that the run failed."
    ),
)

LIMITS = (
    (
        "All frames are rendered and all contacts solved by this repository's simulator, also "
        "those of section V, for which the paper built two prototypes. No real sensor was seen. "
        "The truth is known exactly, so the errors are those of optics, noise and algorithms; a "
        "real gel that differs from its description, a print that is not where it should be, "
        "glue, dust and drift add to them, and they may add unequally to the methods."
    ),
    (
        "Triangulation knows the rig that rendered the frames. The force stage inverts another, "
        "coarser mesh of the same gel with the same moduli. The paper states few of its settings "
        "(material, optics, thresholds, what an error is taken over); what had to be chosen is in "
        "the tables of departures."
    ),
)


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
        Text(INTRODUCTION),
        *_summary(results, facts),
        Heading("How to read this page"),
        *(Text(text) for text in HOW_TO_READ),
        Heading("What a simulation cannot tell"),
        *(Text(text) for text in LIMITS),
        *(block for result in results for block in _section(result)),
        Heading("Claims"),
        *_claims(results),
        Heading("Made with"),
        *made_with(results, facts),
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
    told = len(claims) - met - len(missed)
    rest = f"; {told} of them could not be missed" if told else ""
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
        yield Text(f"Missing, because something failed: {titles}. Their sections tell what.")


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
    head = ("Section", "Claim", "The paper", "Here", "Met")
    rows = tuple(
        (claim.section, claim.what, claim.paper, claim.ours, MET_WORDS[claim.met])
        for claim in all_claims(results)
    )
    if not rows:
        yield Text("There are none.")
        return
    yield Table(head, rows, f"{MET_WORDS[None]}: the paper tells nothing that could be missed.")
