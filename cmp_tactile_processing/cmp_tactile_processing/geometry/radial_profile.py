"""The radial part of a lens model, where it can be inverted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["ACCURACY", "LEAST_SLOPE", "RadialProfile"]

# A profile ends where a step of the ray moves the pixel by less than this share of what it does in
# the middle of the image: there it is about to fold back, and a pixel tells nothing any more.
LEAST_SLOPE = 1e-3
# Inverses are this accurate or NaN, in normalised image coordinates or rad.
ACCURACY = 1e-10
# A residual of this size, relative to 1 + value, is an error of ACCURACY at the least slope.
LARGEST_RESIDUAL = ACCURACY * LEAST_SLOPE
SAMPLES = 257
NEWTON_STEPS = 20
# Newton's method squares the error: a step of this size leaves less than ACCURACY.
LAST_STEP = 1e-8


@dataclass(frozen=True)
class RadialProfile:
    """f(s) = s (1 + k1 s^2 + k2 s^4 + ...), increasing on 0 <= s <= limit.

    s is the tangent of the angle to the optical axis, or the angle itself, as the lens model has
    it.  table: (2, N) samples of s and f.
    """

    coefficients: tuple[float, ...]
    limit: float
    table: NDArray[np.float64]

    @classmethod
    def from_coefficients(
        cls, coefficients: tuple[float, ...], largest: float, tilt: float = 0.0
    ) -> RadialProfile:
        """The profile up to `largest` or to where it stops to increase.

        tilt: size of the distortion that is not radial; the profile then ends where
        f'(s) or f(s) / s falls to tilt s.
        """
        odd = np.zeros(2 * len(coefficients) + 1)
        odd[0], odd[2::2] = 1.0, coefficients
        falling = [odd * np.arange(1, len(odd) + 1)]
        if tilt > 0:
            falling.append(odd)
        limit = min([largest, *(_first_root(item, tilt) for item in falling)])
        # Uniform in angle for a tangent that grows without bound, close to uniform for the rest.
        s = np.tan(np.linspace(0, np.arctan(limit), SAMPLES))
        s[-1] = limit
        f = s * _even(coefficients, s * s)
        return cls(coefficients, limit, np.stack([s, f]))

    def scale(self, s2: NDArray[np.float64]) -> NDArray[np.float64]:
        """f(s) / s, from s^2."""
        return _even(self.coefficients, s2)

    def slope(self, s2: NDArray[np.float64]) -> NDArray[np.float64]:
        """f'(s), from s^2."""
        odd = tuple((2 * i + 3) * k for i, k in enumerate(self.coefficients))
        return _even(odd, s2)

    def inverse(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """s >= 0 with f(s) = value to ACCURACY; NaN where there is none up to the limit."""
        s_table, f_table = self.table
        index = np.clip(np.searchsorted(f_table, value, "right") - 1, 0, SAMPLES - 2)
        low, high = s_table[index], s_table[index + 1]
        s = low + (value - f_table[index]) / (f_table[index + 1] - f_table[index]) * (high - low)
        for _ in range(NEWTON_STEPS):
            s2 = s * s
            step = (s * self.scale(s2) - value) / self.slope(s2)
            s = np.clip(s - step, low, high)
            if not (np.abs(step) > LAST_STEP).any():
                break
        residual = np.abs(s * self.scale(s * s) - value)
        return np.where(residual <= LARGEST_RESIDUAL * (1 + value), s, np.nan)


def _even(coefficients: tuple[float, ...], s2: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 + k1 s^2 + k2 s^4 + ..., by Horner's rule."""
    total = np.zeros_like(s2)
    for k in reversed(coefficients):
        total = (total + k) * s2
    return total + 1.0


def _first_root(polynomial: NDArray[np.float64], tilt: float) -> float:
    """Smallest s > 0 at which 1 + ... - tilt s falls to LEAST_SLOPE; inf where it never does."""
    shifted = polynomial.copy()
    shifted[0] -= LEAST_SLOPE
    shifted[1] -= tilt
    if not shifted[1:].any():
        return np.inf
    roots = np.roots(shifted[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if len(real) else np.inf
