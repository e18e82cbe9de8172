"""Corners of the pattern and how gridlines connect them: what every detector finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage

__all__ = ["STEPS", "Component", "CornerGraph", "GridlineDetector"]

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
class Component:
    """Connected inner corners: position (n, 2) px, number (n, 2) from an unknown origin, even."""

    position: NDArray[np.float64]
    number: NDArray[np.intp]
    even: NDArray[np.bool_]

    def lattice(self) -> tuple[NDArray[np.float64], bool]:
        """Positions by number from (0, 0), (R, C, 2) px, NaN where none; whether (0, 0) is even."""
        number = self.number - self.number.min(axis=0)
        lattice = np.full((*(number.max(axis=0) + 1), 2), np.nan)
        lattice[number[:, 0], number[:, 1]] = self.position
        return lattice, bool(self.even[0]) == (int(number[0].sum()) % 2 == 0)


class GridlineDetector(Protocol):
    """Finds the corners in an image and how gridlines connect them, knowing no earlier frame."""

    def corner_graph(self, image: PreparedImage) -> CornerGraph:
        """Corners, to a pixel or two, in pixels of the prepared image; may be empty."""
