"""The fixed point between a linear inverse and what large strain adds to the displacement."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["settle"]

Array = NDArray[np.float64]

# What is taken off stands when it differs by less than this share of a marker's noise and of the
# displacement (root mean squares) from what the solution found with it adds.
NOISE_SHARE, SHARE = 0.1, 1.5e-3
MAX_ROUNDS = 10
# Accuracy that is asked of the excess: the tolerance in the end and in the first round of a warm
# start, a share of the displacement in the first round of others and of the last round's change
# later on, where more would be wasted.
FIRST_ACCURACY, ACCURACY = 0.02, 0.15
# Earlier rounds from which the next is extrapolated.
DEPTH = 2


def settle(
    solve: Callable[[Array], Array],
    excess: Callable[[Array, float], Array],
    displacement: Array,
    start: Array | None = None,
    noise: float = 2e-6,
) -> tuple[Array, bool]:
    """Solution f of f = solve(displacement - excess(f)), and whether it stands.

    excess(f, accuracy): to that accuracy, m, as LargePress.excess.  displacement (rows, cols, 3)
    m may hold NaN, which `solve` is given as it is.  start: excess to begin with, of the last
    frame for example; none by default.  noise: standard deviation of a marker's displacement, m.
    Raises what `solve` and `excess` raise.

    Rounds are extrapolated (Anderson acceleration, Walker and Ni 2011).
    """
    warm = start is not None and bool(np.any(start))
    added = np.array(start, dtype=np.float64) if warm else np.zeros(displacement.shape)
    known = np.isfinite(displacement)
    moved = _size(displacement[known]) if known.any() else 0.0
    tolerance = max(NOISE_SHARE * noise, SHARE * moved)
    accuracy = tolerance if warm else max(tolerance, FIRST_ACCURACY * moved)
    found: list[tuple[Array, Array]] = []
    solution = solve(displacement - added)
    for _ in range(MAX_ROUNDS):
        result = excess(solution, accuracy)
        change = result - added
        if _size(change) <= tolerance and accuracy <= tolerance:
            return solution, True
        accuracy = max(tolerance, min(accuracy, ACCURACY * _size(change)))
        found = [*found, (result, change)][-DEPTH - 1 :]
        added = _extrapolated(found)
        solution = solve(displacement - added)
    return solution, False


def _extrapolated(found: list[tuple[Array, Array]]) -> Array:
    """The mixture of the latest results whose change is least."""
    result, change = found[-1]
    if len(found) == 1:
        return result
    results = np.stack([(result - earlier).ravel() for earlier, _ in found[:-1]], axis=1)
    changes = np.stack([(change - earlier).ravel() for _, earlier in found[:-1]], axis=1)
    shares = np.linalg.lstsq(changes.T @ changes, changes.T @ change.ravel(), rcond=1e-6)[0]
    return np.asarray(result - (results @ shares).reshape(result.shape))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
