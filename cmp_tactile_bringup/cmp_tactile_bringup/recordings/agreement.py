"""How two measurements of the same force agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """How two forces over time agree, along x, y and z.

    correlation (3,); scale: of ours that comes nearest to theirs, all axes together; left (3,) N:
    root mean square of the difference then; frames: that were compared.
    """

    correlation: Array
    scale: float
    left: Array
    frames: int


def agreement(ours: Array, theirs: Array) -> Agreement | None:
    """Of forces (n, 3) N; None where there are fewer than two frames with both."""
    known = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
    ours, theirs = ours[known], theirs[known]
    if len(ours) < 2 or not ours.any():
        return None
    scale = float(np.vdot(ours, theirs) / np.vdot(ours, ours))
    left = np.sqrt(np.mean((scale * ours - theirs) ** 2, axis=0))
    return Agreement(_correlations(ours, theirs), scale, left, len(ours))


def _correlations(ours: Array, theirs: Array) -> Array:
    """Along each axis (3,), NaN where one of the two does not change."""
    ours, theirs = ours - ours.mean(axis=0), theirs - theirs.mean(axis=0)
    sizes = np.sqrt((ours**2).sum(axis=0) * (theirs**2).sum(axis=0))
    return np.asarray((ours * theirs).sum(axis=0) / np.where(sizes > 0, sizes, np.nan))
