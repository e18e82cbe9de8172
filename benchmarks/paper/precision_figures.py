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

    systematic: what all draws of noise share.  random: their spread.
    """

    systematic: float
    random: float


@dataclass(frozen=True)
class Summary:
    """Displacement errors of a method in one state of the gel, m.

    rms, largest (3,) along x, y, z: RMS over markers and draws, mean over draws of the largest.
    inside, outside (3,): RMS of the markers in contact, and of the others.
    measured, wrong: share of the visible markers found, number of those with wrong numbers.
    """

    rms: Array
    largest: Array
    inside: Array
    outside: Array
    measured: float
    wrong: int

    @property
    def space(self) -> float:
        """RMS of the error's length."""
        return float(np.linalg.norm(self.rms))

    @property
    def concentration(self) -> Array:
        """How many times larger errors along x, y, z are in contact than outside of it, (3,)."""
        return self.inside / self.outside

    @property
    def typical_concentration(self) -> float:
        """Geometric mean of `concentration` over the axes: z, where errors are largest, is one."""
        return float(np.exp(np.log(self.concentration).mean()))


def summary_of(told: Arrays, method: Method, phase: int) -> Summary:
    """Of the results of `loads` or `sharper`."""
    errors = np.asarray(told[f"{method.key}_errors"][:, phase], dtype=np.float64)
    inside = np.asarray(told["inside"][phase], dtype=np.bool_)
    visible, found, wrong = told[f"{method.key}_counts"][:, phase].sum(axis=0).tolist()
    return Summary(
        rms=root_mean_square(errors),
        largest=np.mean([largest(draw) for draw in errors], axis=0),
        inside=root_mean_square(errors[:, inside]),
        outside=root_mean_square(errors[:, ~inside]),
        measured=found / visible,
        wrong=wrong,
    )


def split_of(errors: NDArray[np.floating]) -> Split:
    """Of errors (draws, rows, cols, 3) m, two draws or more; markers missing in one are left out.

    The mean over draws still holds a share of the noise, which its spread tells.
    """
    complete = np.isfinite(errors).all(axis=(0, -1))
    known = np.asarray(errors, dtype=np.float64)[:, complete]
    random = known.var(axis=0, ddof=1).sum(axis=-1).mean()
    shared = (known.mean(axis=0) ** 2).sum(axis=-1).mean() - random / len(known)
    return Split(float(np.sqrt(max(shared, 0.0))), float(np.sqrt(random)))
