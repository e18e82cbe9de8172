"""What an experiment is made of: cases that are computed, and a report of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Arrays",
    "Block",
    "Busy",
    "Case",
    "Claim",
    "Deviation",
    "Experiment",
    "Figure",
    "Report",
    "Results",
    "Table",
    "Text",
    "Workplace",
    "number",
]

Arrays = Mapping[str, NDArray[Any]]
Results = Mapping[str, Arrays]


@dataclass(frozen=True)
class Workplace:
    """Where cases keep what other cases use as well.

    fast: the quick run, see `Experiment`.  patient: whether to wait for what another process is
    at; otherwise Busy is raised, and the runner lets the case begin anew later.
    """

    folder: Path
    fast: bool = False
    patient: bool = True


class Busy(Exception):  # noqa: N818  nothing went wrong
    """Another process is at what is needed here."""


@dataclass(frozen=True)
class Case:
    """A part of an experiment that is computed by itself, in a process of its own.

    name: of a file.  work: function of a module, called with the workplace and the arguments; its
    result is kept, and taken again as long as neither the arguments nor the sources that the
    function rests on have changed.  arguments: their repr() must tell them apart.
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

    section: of the paper.  met: None where the paper tells nothing that could be missed.
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
    """A table; rows of texts, the first column names what the others tell."""

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
    """What an experiment tells: blocks in reading order, claims for the last table."""

    blocks: tuple[Block, ...]
    claims: tuple[Claim, ...] = ()
    deviations: tuple[Deviation, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """An experiment of the paper, or beyond it.

    key: of --only and of file names.  section: of the paper, "" for what it does not have.
    cases: those of a workplace; the fast run has fewer or smaller ones.
    report: draws the figures into the folder and tells the rest, from the results by case name.
    """

    key: str
    section: str
    title: str
    cases: Callable[[Workplace], Sequence[Case]]
    report: Callable[[Results, Path], Report]


def number(arrays: Arrays, name: str) -> float:
    """A result that is one number."""
    return float(np.asarray(arrays[name]).item())
