"""Measured corners of a numbered grid: positions, deviations, and where each comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MeasuredCorners:
    """position (rows, cols, 2) px, std (rows, cols) px per coordinate; NaN where not measured.

    predicted (rows, cols): the position is what the corners around leave room for, no more.
    modelled (rows, cols), pull (rows, cols, 2, 4): as of `SaddlePoints`.
    """

    position: NDArray[np.float64]
    std: NDArray[np.float64]
    predicted: NDArray[np.bool_]
    modelled: NDArray[np.bool_]
    pull: NDArray[np.float64]

    @property
    def missing(self) -> int:
        """Number of corners without a position."""
        return int(np.isnan(self.position[..., 0]).sum())

    @property
    def off_model(self) -> NDArray[np.bool_]:
        """Corners (rows, cols) to which no model was fitted though it was to others: of a flaw."""
        return np.asarray(~self.modelled & self.modelled.any())

    def without(self, lost: NDArray[np.bool_]) -> MeasuredCorners:
        """The corners less those of a mask (rows, cols)."""
        corners = self.copy()
        # What is found at its place otherwise was not fitted with these edges.
        corners.put(lost, np.nan, np.nan)
        return corners

    def none(self) -> MeasuredCorners:
        """A grid of the same size of which no corner is known."""
        return self.without(np.ones_like(self.predicted))

    def copy(self) -> MeasuredCorners:
        """The same corners, of which some may be set."""
        return MeasuredCorners(*(array.copy() for array in self._arrays))

    def take(self, where: NDArray[np.bool_], found: MeasuredCorners) -> None:
        """Set the corners of a mask (rows, cols) to those that were fitted."""
        for own, other in zip(self._arrays, found._arrays, strict=True):
            own[where] = other[where]

    def put(
        self,
        where: NDArray[np.bool_],
        position: float | NDArray[np.float64],
        std: float | NDArray[np.float64],
        predicted: bool | NDArray[np.bool_] = False,
    ) -> None:
        """Set the n corners of a mask (rows, cols) to positions (n, 2) that were not fitted."""
        self.position[where], self.std[where] = position, std
        self.predicted[where], self.modelled[where], self.pull[where] = predicted, False, 0.0

    @property
    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return self.position, self.std, self.predicted, self.modelled, self.pull
