"""When two contacts are told apart: a criterion on the depth along the line through both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_DIP", "RAYLEIGH_DIP", "dip_between", "line_through", "smallest_told_apart"]

# Between two points of light that are just resolved the light falls to 73.5 % (Rayleigh).
RAYLEIGH_DIP = 0.265
# Two maxima at all, by more than noise and interpolation make of one.
LEAST_DIP = 0.05
# The line goes on so far beyond both contacts, and its points are so far apart, m.
BEYOND, STEP = 0.4e-3, 25e-6

Array = NDArray[np.float64]


def line_through(centre: Array, angle: float, separation: float) -> Array:
    """Points (n, 2) m on the line through two contacts; the middle one is half way."""
    count = round((separation / 2 + BEYOND) / STEP)
    along = np.arange(-count, count + 1) * STEP
    return np.asarray(centre + along[:, None] * (np.cos(angle), np.sin(angle)))


def dip_between(depth: Array) -> float:
    """By what share of the smaller of two maxima the depth falls between them.

    depth (n,): along `line_through`, a maximum on each side of its middle.  0 where it does not
    fall; NaN where a depth is missing or nothing is pressed in.
    """
    middle = len(depth) // 2
    first = int(np.argmax(depth[: middle + 1]))
    second = middle + int(np.argmax(depth[middle:]))
    smaller = float(min(depth[first], depth[second]))
    if not np.isfinite(depth).all() or smaller <= 0:
        return float("nan")
    return 1.0 - float(depth[first : second + 1].min()) / smaller


def smallest_told_apart(separation: Array, told: NDArray[np.bool_], share: float = 1.0) -> float:
    """The separation down to which this share of all pairs is told apart, m.

    told (n,): of pairs at separations (n,), m.  NaN where not even the widest are.
    """
    reached = float("nan")
    for step in np.unique(separation)[::-1]:
        if told[separation == step].mean() < share:
            break
        reached = float(step)
    return reached
