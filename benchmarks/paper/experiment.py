"""What an experiment is made of: cases that are computed, and a function that reports on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paper.blocks import Report

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
