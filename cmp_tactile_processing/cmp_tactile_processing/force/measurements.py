"""What of a frame a force follows from: displacements in units of their noise, where known."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.measured import Status, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription

# A marker whose deviation is so many times the median's shows next to nothing.
MUCH_NOISIER = 4.0

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Measurements(NamedTuple):
    """data (3 markers,) in units of the noise, known (3 markers,), valid: share of the markers.

    contacts: whether more is asked for than the force: see ForceModel.reconstruct.
    """

    data: Array
    known: Mask
    valid: float
    contacts: bool = True


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

    def measurements(
        self, displacement: Array, status: NDArray[np.uint8], covariance: Array | None
    ) -> Measurements:
        """Of a frame: see ForceModel.reconstruct."""
        moved, states = np.asarray(displacement, dtype=np.float64), np.asarray(status)
        self._check(moved, states, covariance)
        moved = within_reach(moved, self._sensor).reshape(-1, 3)
        known = np.isfinite(moved) & (states.reshape(-1, 1) != Status.MISSING.value)
        if covariance is not None:
            known &= ~_much_noisier(covariance, known.any(axis=1, keepdims=True))
        if not self.depth_seen:
            known[:, 2] = False
        valid = np.count_nonzero(known.any(axis=1)) / len(known)
        known = known.ravel()
        return Measurements(self.in_noise(moved, known), known, valid)

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
                raise GeometryError(msg)


def _much_noisier(covariance: Array, known: Mask) -> Mask:
    """Markers (n, 1) that are much less certain than most of the known (n, 1)."""
    variance = np.einsum("ijkk->ij", covariance).reshape(-1, 1)
    stated = np.isfinite(variance) & (variance > 0)
    seen = stated & known
    if not seen.any():
        return np.zeros_like(seen)
    return np.asarray(stated & (variance > MUCH_NOISIER**2 * np.median(variance[seen])))


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
