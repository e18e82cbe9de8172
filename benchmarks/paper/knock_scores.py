"""Up to which jump of the markers from frame to frame a method holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.grasp_scores import LIMIT
from paper.knock import COLUMNS

__all__ = ["KnockScore", "largest_held"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KnockScore:
    """Of one method over knocks of all sizes.

    jump (N,) pitches, rising.  wrong, lost, force (N,): of the knock's frame, shares of the visible
    markers with wrong numbers and of those not found, error of the force as a share of the peak;
    infinite where there was none.  approach: whether all was well before each knock.
    """

    jump: Array
    wrong: Array
    lost: Array
    force: Array
    wrong_after: Array
    force_after: Array
    approach: bool

    @classmethod
    def from_knocks(cls, knocks: Array) -> KnockScore:
        """From results (..., COLUMNS) of `knocks`, of one or many directions."""
        rows = knocks.reshape(-1, len(COLUMNS))
        told = dict(zip(COLUMNS, rows[np.argsort(rows[:, 0], kind="stable")].T, strict=True))
        return cls(
            told["jump"],
            told["wrong"],
            1 - told["found"],
            _known(told["force"]),
            told["after"],
            _known(told["force_after"]),
            bool((told["before"] == 0).all()),
        )

    @property
    def misnumbers_from(self) -> float | None:
        """The smallest jump with a wrong number, pitches; None where there is none."""
        return _smallest(self.jump, self.wrong > 0)

    @property
    def fails_from(self) -> float | None:
        """The smallest jump whose force is off by more than LIMIT; None where none is."""
        return _smallest(self.jump, self.force > LIMIT)

    @property
    def always_misnumbers_from(self) -> float | None:
        """The jump from which on all knocks bring wrong numbers; None where the largest do not."""
        right = np.flatnonzero(self.wrong == 0)
        first = 0 if not len(right) else int(right[-1]) + 1
        return float(self.jump[first]) if first < len(self.jump) else None


def largest_held(score: KnockScore) -> float | None:
    """The largest jump up to which all knocks hold, pitches; None where the smallest does not."""
    held = (score.wrong == 0) & (score.force <= LIMIT)
    count = len(held) if held.all() else int(np.argmin(held))
    return float(score.jump[count - 1]) if count else None


def _known(error: Array) -> Array:
    return np.where(np.isfinite(error), error, np.inf)


def _smallest(jump: Array, where: NDArray[np.bool_]) -> float | None:
    return float(jump[where].min()) if where.any() else None
