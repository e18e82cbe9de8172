"""Statistics of the spheres that readings of balls give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paper.experiment import Arrays, number

__all__ = ["BallFits", "clearly_less"]

# A difference is clear from so many of its standard errors on.
CLEAR = 2.0


@dataclass(frozen=True)
class BallFits:
    """Fits of one reading; ball (B,) diameters in m, others (B, presses).

    diameter, rms: m; count: of markers; exact: diameter fitted to the true places of the markers
    that the reading takes, m.
    """

    ball: NDArray[np.float64]
    diameter: NDArray[np.float64]
    rms: NDArray[np.float64]
    count: NDArray[np.float64]
    exact: NDArray[np.float64]

    @classmethod
    def from_results(cls, results: Sequence[Arrays], reading: str, exact: str) -> BallFits:
        """From the arrays of `balls.fit_balls`, balls in rising order."""
        rows = sorted(results, key=lambda arrays: number(arrays, "ball"))

        def all_of(name: str) -> NDArray[np.float64]:
            return np.array([np.asarray(arrays[name], np.float64).ravel() for arrays in rows])

        return cls(
            np.array([number(arrays, "ball") for arrays in rows]),
            all_of(f"{reading}_diameter"),
            all_of(f"{reading}_rms"),
            all_of(f"{reading}_count"),
            all_of(f"{exact}_diameter"),
        )

    @property
    def from_ball(self) -> NDArray[np.float64]:
        """Fitted minus the ball's diameter, m."""
        return np.asarray(self.diameter - self.ball[:, None])

    @property
    def from_exact(self) -> NDArray[np.float64]:
        """Fitted minus the diameter that exact markers give, m."""
        return np.asarray(self.diameter - self.exact)

    def beside_layer(self, layer: float) -> NDArray[np.float64]:
        """Fitted minus the ball's diameter, with the markers a layer (m) farther out, m."""
        return np.asarray(self.from_ball - 2 * layer)

    @property
    def failed(self) -> int:
        """Presses that gave no sphere."""
        return int(np.count_nonzero(np.isnan(self.diameter)))


def clearly_less(
    first: NDArray[np.float64], second: NDArray[np.float64], repetitions: int = 1
) -> bool:
    """Whether the first of paired deviations are smaller in size, by more than chance makes them.

    The mean of |first| - |second| lies below zero by more than CLEAR of its standard errors.
    repetitions: so many presses in a row differ in noise alone and are averaged, as they share
    what place and ball do.  Presses without a fit are left out of both.
    """
    difference = (np.abs(first) - np.abs(second)).reshape(-1, repetitions).mean(axis=1)
    difference = difference[np.isfinite(difference)]
    if len(difference) < 2:
        return False
    error = float(np.std(difference, ddof=1)) / len(difference) ** 0.5
    return bool(difference.mean() < -CLEAR * error)
