"""From counts of markers to the level at which a method fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.experiment import Arrays

__all__ = ["Endurance"]

HALF = 0.5


@dataclass(frozen=True)
class Endurance:
    """How a method fares from level to level, from good to bad, (L,) each.

    success: share of the frames in which every visible marker is found and none bears a wrong
    number, of a gel that has its reference.  found: markers found of those visible.
    wrong: markers with wrong numbers.
    error: median over frames of the median error of a displacement, m; NaN without any.
    """

    levels: NDArray[np.float64]
    success: NDArray[np.float64]
    found: NDArray[np.float64]
    wrong: NDArray[np.int64]
    error: NDArray[np.float64]

    @classmethod
    def from_arrays(cls, arrays: Arrays, method: str) -> Endurance:
        """From the arrays of `reliability.expose_and_track`."""
        found, wrong, visible = (
            np.asarray(arrays[f"{method}_{name}"]) for name in ("found", "wrong", "visible")
        )
        over = tuple(range(1, found.ndim))
        referenced = np.asarray(arrays[f"{method}_referenced"])
        works = (found == visible) & (wrong == 0) & referenced[..., None]
        error = np.asarray(arrays[f"{method}_error"], dtype=np.float64).reshape(len(found), -1)
        median = np.full(len(error), np.nan)
        known = np.isfinite(error).any(axis=1)
        median[known] = np.nanmedian(error[known], axis=1)
        return cls(
            np.asarray(arrays["levels"], dtype=np.float64),
            works.mean(axis=over),
            found.sum(axis=over) / visible.sum(axis=over),
            wrong.sum(axis=over),
            median,
        )

    @property
    def fails_at(self) -> int | None:
        """Index of the first level where a marker is lost or has a wrong number in any frame."""
        return _first(self.success < 1)

    @property
    def half_lost_at(self) -> int | None:
        """Index of the first level where half of all markers are lost, or more."""
        return _first(self.found <= HALF)

    @property
    def bears(self) -> float | None:
        """The worst level before it begins to fail; None where it fails at the first."""
        first = self.fails_at
        if first == 0:
            return None
        return float(self.levels[-1 if first is None else first - 1])

    def outlasts(self, other: Endurance) -> int:
        """1, 0 or -1: whether it begins to fail later than another, with it, or earlier."""
        mine, others = (
            len(self.levels) if e.fails_at is None else e.fails_at for e in (self, other)
        )
        return int(np.sign(mine - others))


def _first(where: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(where)) if where.any() else None
