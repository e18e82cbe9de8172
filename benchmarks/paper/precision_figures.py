"""What the errors of IV.D come to: sizes, parts, regions, the best of the dots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.experiment import Arrays
from paper.marker_errors import largest, root_mean_square
from paper.method import Method

__all__ = ["AXES", "Split", "Summary", "split_of", "summary_of"]

Array = NDArray[np.float64]

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Split:
    """What errors consist of, RMS in space, m.

    systematic: what is left without noise.  random: the spread over draws of noise.
    """

    systematic: float
    random: float


@dataclass(frozen=True)
class Summary:
    """Displacement errors of a method in one state of the gel, m.

    rms, largest (3,) along x, y, z: RMS over markers and draws, mean over draws of the largest.
    inside, outside: RMS in space of the markers in contact, and of the others.
    measured, wrong: share of the visible markers found, number of those with wrong numbers.
    """

    rms: Array
    largest: Array
    inside: float
    outside: float
    measured: float
    wrong: int

    @property
    def space(self) -> float:
        """RMS of the error's length."""
        return float(np.linalg.norm(self.rms))

    @property
    def concentration(self) -> float:
        """How many times larger errors are in contact than outside of it."""
        return self.inside / self.outside


def summary_of(told: Arrays, method: Method, phase: int) -> Summary:
    """Of the results of `loads` or `sharper`."""
    errors = np.asarray(told[f"{method.key}_errors"][:, phase], dtype=np.float64)
    inside = np.asarray(told["inside"][phase], dtype=np.bool_)
    visible, found, wrong = told[f"{method.key}_counts"][:, phase].sum(axis=0).tolist()
    return Summary(
        rms=root_mean_square(errors),
        largest=np.mean([largest(draw) for draw in errors], axis=0),
        inside=float(np.linalg.norm(root_mean_square(errors[:, inside]))),
        outside=float(np.linalg.norm(root_mean_square(errors[:, ~inside]))),
        measured=found / visible,
        wrong=wrong,
    )


def split_of(told: Arrays, method: Method, phase: int) -> Split:
    """Of the results of `loads` or `sharper`; two draws or more."""
    errors = np.asarray(told[f"{method.key}_errors"][:, phase], dtype=np.float64)
    clean = root_mean_square(told[f"{method.key}_clean"][phase])
    spread = np.var(errors, axis=0, ddof=1).sum(axis=-1)
    return Split(float(np.linalg.norm(clean)), float(np.sqrt(np.nanmean(spread))))
