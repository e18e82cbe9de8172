"""What of a frame a force follows from: displacements in units of their noise, where known."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, plain
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import Status, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription

# A marker whose deviation is so many times the median's, and more than such a share of how far it
# has moved, shows less than its neighbours say of it.
MUCH_NOISIER, MUCH_OF_MOTION = 5.0, 0.1
MISSING = int(Status.MISSING)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Measurements(NamedTuple):
    """data (3 markers,) in units of the noise, known (3 markers,), valid: share of the markers.

    variance (3 markers,): of the data, as the frame states it, NaN where it does not.
    contacts: whether more is asked for than the force: see ForceModel.reconstruct.
    """

    data: Array
    known: Mask
    valid: float
    variance: Array
    contacts: bool = True

    def stated_noise(self) -> float:
        """Median standard deviation that the frame states for the data; NaN where it does not."""
        stated = np.where(self.known, self.variance, np.nan).reshape(-1, 3)
        stated = stated[np.isfinite(stated).all(axis=1)]
        return math.sqrt(np.median(stated, axis=0).mean()) if len(stated) else math.nan


class Whitening:
    """Displacements of one sensor's markers in units of their noise, and back.

    noise (3 markers,) m; depth_seen: whether more than one view, or whatever
    measures the markers of a sensor without views, shows how deep they are.
    """

    def __init__(self, sensor: SensorDescription, markers: SurfaceGrid) -> None:
        parameters = sensor.force
        one = (parameters.noise_in_plane, parameters.noise_in_plane, parameters.noise_depth)
        self.noise = np.tile(one, markers.rows * markers.cols)
        self.depth_seen = len(sensor.views) != 1
        self._sensor = sensor
        self._shape = markers.rows, markers.cols
        self._farthest = float(max(sensor.elastomer.size))
        self._no_covariance = np.full((*self._shape, 3, 3), np.nan)

    def measurements(
        self, displacement: Array, status: NDArray[np.uint8], covariance: Array | None
    ) -> Measurements:
        """Of a frame: see ForceModel.reconstruct."""
        moved, states = np.asarray(displacement, dtype=np.float64), np.asarray(status)
        self._check(moved, states, covariance)
        given = self._no_covariance if covariance is None else np.asarray(covariance)
        moved = plain(moved, np.float64).reshape(-1, 3)
        known, variance = _known(
            moved,
            plain(states, np.uint8).reshape(-1),
            plain(given, np.float64).reshape(-1, 3, 3),
            self._farthest,
            self.depth_seen,
        )
        stated = variance[np.isfinite(variance)]
        most = MUCH_NOISIER**2 * float(np.median(stated)) if len(stated) else math.inf
        data, count = _in_noise(moved, variance, most, self.noise, known)
        stated = np.diagonal(given, axis1=2, axis2=3).reshape(-1) / self.noise**2
        return Measurements(data, known.reshape(-1), count / len(known), stated)

    def in_noise(self, moved: Array, known: Mask) -> Array:
        """Displacements of any shape, m, as data (3 markers,), 0 where they are not known."""
        return np.where(known, moved.ravel() / self.noise, 0.0)

    def in_metres(self, data: Array, known: Mask) -> Array:
        """Data (3 markers,) as (rows, cols, 3) m, NaN where they are not known."""
        return np.where(known, data * self.noise, np.nan).reshape(*self._shape, 3)

    def _check(self, moved: Array, states: NDArray[Any], covariance: Array | None) -> None:
        expected: list[tuple[str, NDArray[Any], tuple[int, ...]]] = [
            ("displacement", moved, (*self._shape, 3)),
            ("status", states, self._shape),
        ]
        if covariance is not None:
            expected.append(("covariance", np.asarray(covariance), (*self._shape, 3, 3)))
        for name, found, wanted in expected:
            if found.shape != wanted:
                msg = f"{self._sensor.name}: {name}: found shape {found.shape}, expected {wanted}"
                raise InputError(msg)


@kernel
def _known(
    moved: Array,
    status: NDArray[np.uint8],
    covariance: Array,
    farthest: float,
    depth_seen: bool,
) -> tuple[Mask, Array]:
    """Which components (n, 3) of markers are measured, and the variance (n,) of these markers.

    moved (n, 3) m; status (n,); covariance (n, 3, 3) m^2; farthest: that a marker may move, m.
    The variance is the sum of all components', NaN where it is not known.
    """
    known = np.zeros(moved.shape, np.bool_)
    variance = np.full(len(moved), np.nan)
    for n in range(len(moved)):
        reached, some = status[n] != MISSING, False
        for c in range(3):
            reached &= not abs(moved[n, c]) > farthest
        for c in range(3):
            finite = reached and math.isfinite(moved[n, c])
            some |= finite
            known[n, c] = finite and (depth_seen or c < 2)
        total = covariance[n, 0, 0] + covariance[n, 1, 1] + covariance[n, 2, 2]
        if some and math.isfinite(total) and total > 0:
            variance[n] = total
    return known, variance


@kernel
def _in_noise(
    moved: Array, variance: Array, most: float, noise: Array, known: Mask
) -> tuple[Array, int]:
    """Data (3 n,) in units of the noise, 0 where not known, and how many markers are known.

    Markers of a larger variance than `most`, and than that of a share of their motion, are struck
    from the known (n, 3).
    """
    data: Array = np.zeros(known.size)
    count = 0
    for n in range(len(known)):
        some, motion = False, 0.0
        for c in range(3):
            motion += moved[n, c] ** 2 if known[n, c] else 0.0
        least = max(most, MUCH_OF_MOTION**2 * motion)
        for c in range(3):
            known[n, c] &= not variance[n] > least
            some |= known[n, c]
            if known[n, c]:
                data[3 * n + c] = moved[n, c] / noise[3 * n + c]
        count += some
    return data, count


def within_reach(
    displacement: NDArray[np.float64], sensor: SensorDescription
) -> NDArray[np.float64]:
    """Displacement (rows, cols, 3) m, NaN where it is no measurement.

    No marker moves farther than the gel is large.
    """
    farthest = max(sensor.elastomer.size)
    # Not by the largest of them, which may be NaN.
    beyond = np.any(np.abs(displacement) > farthest, axis=-1, keepdims=True)
    return np.where(beyond, np.nan, displacement) if beyond.any() else displacement
