"""What an experiment is made of: cases that are computed, and a report of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Arrays = Mapping[str, NDArray[Any]]
Results = Mapping[str, Arrays]


@dataclass(frozen=True)
class Workplace:
    """Where cases keep what other cases use as well.  fast: the quick run, see `Experiment`."""

    folder: Path
    fast: bool = False


@dataclass(frozen=True)
class Case:
    """A part of an experiment that is computed by itself, in a process of its own.

    name: of a file.  work: function of a module, called with the workplace and the arguments; its
    result is kept, and taken again as long as neither the arguments nor the sources that the
    function rests on have changed.  arguments: their repr() must differ where they do.
    seconds: roughly, on one core, for the order and the progress.  alone: while no other case
    runs, for one that looks at the time.
    """

    name: str
    work: Callable[..., Mapping[str, NDArray[Any] | float | str]]
    arguments: tuple[Any, ...] = ()
    seconds: float = 10.0
    alone: bool = False


@dataclass(frozen=True)
class Claim:
    """A figure or sentence of the paper beside ours.

    section: of the paper.  met: None where the paper states nothing that could be missed.
    """

    section: str
    what: str
    paper: str
    ours: str
    met: bool | None


@dataclass(frozen=True)
class Deviation:
    """Where an experiment departs from the paper's set-up, and why."""

    what: str
    paper: str
    here: str
    why: str


@dataclass(frozen=True)
class Text:
    """A paragraph; `code` between backquotes, nothing else is marked up."""

    text: str


@dataclass(frozen=True)
class Table:
    """A table; rows of texts, the first column is a name."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True)
class Figure:
    """A PNG file that the report has written."""

    path: Path
    caption: str


Block = Text | Table | Figure


@dataclass(frozen=True)
class Report:
    """What an experiment found: blocks in reading order, claims for the last table."""

    blocks: tuple[Block, ...]
    claims: tuple[Claim, ...] = ()
    deviations: tuple[Deviation, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper, or beyond it.

    key: of --only and of file names.  section: of the paper, "" for what it does not have.
    cases: those of a workplace; the fast run has fewer or smaller ones.
    report: draws the figures into the folder, from the results by case name.
    """

    key: str
    section: str
    title: str
    cases: Callable[[Workplace], Sequence[Case]]
    report: Callable[[Results, Path], Report]


def number(arrays: Arrays, name: str) -> float:
    """A result that is one number."""
    return float(np.asarray(arrays[name]).item())


@cache
def _prose() -> dict[str, Any]:
    """All that is written on the page, by experiment."""
    path = Path(__file__).with_name("prose.yaml")
    texts: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return texts


def prose(experiment: str, name: str, **values: object) -> Text:
    """A paragraph of prose.yaml with its fields filled in."""
    return Text(_prose()[experiment]["texts"][name].format(**values))


def deviations(experiment: str, **values: object) -> tuple[Deviation, ...]:
    """All departures of an experiment from the paper, with their fields filled in."""
    rows = _prose()[experiment]["deviations"]
    return tuple(Deviation(**{k: text.format(**values) for k, text in row.items()}) for row in rows)
