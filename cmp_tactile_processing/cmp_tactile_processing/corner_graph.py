"""Corners of the pattern and how gridlines connect them: what every detector finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["STEPS", "CornerGraph", "Island"]

# Pointers towards i-1, j+1, i+1, j-1 as steps in (i, j).
STEPS = np.array([[-1, 0], [0, 1], [1, 0], [0, -1]])


@dataclass(frozen=True)
class CornerGraph:
    """Corners of the pattern with pointers to their neighbours along the gridlines.

    position (n, 2) px; merged (n,) bool: an inner corner, shared by two checkers;
    even (n,) bool: the dark checkers touch it along the diagonal (-, -) to (+, +);
    neighbour (n, 4): index of the next corner towards i-1, j+1, i+1, j-1, or -1.
    """

    position: NDArray[np.float64]
    merged: NDArray[np.bool_]
    even: NDArray[np.bool_]
    neighbour: NDArray[np.intp]


@dataclass(frozen=True)
class Island:
    """Connected inner corners: position (n, 2) px, number (n, 2) from an unknown origin, even."""

    position: NDArray[np.float64]
    number: NDArray[np.intp]
    even: NDArray[np.bool_]
