"""The rigid motion, with a scale if wanted, that brings one set of markers onto another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array: TypeAlias = NDArray[np.float64]

# Share of the markers that a contact leaves where they were, and rounds to find them.
KEPT_SHARE = 0.7
ROUNDS = 4
# Fewer markers do not separate a motion from their noise.
LEAST_MARKERS = 6
# Of a marker and its eight neighbours, so many must be known.
LEAST_NEIGHBOURS = 5


@dataclass(frozen=True)
class Motion:
    """How a set of markers moved, gel frame.

    shift (3,) m: of the markers' centre; its z is NaN where no depth is known.  rotation (3, 3):
    about the centre.  scale: by which lengths grew, 1 where none was fitted.
    residual (rows, cols, 3) m: what is left of each marker's motion.
    """

    shift: NDArray[np.float64]
    rotation: NDArray[np.float64]
    scale: float
    residual: NDArray[np.float64]

    @property
    def turn(self) -> NDArray[np.float64]:
        """Rotation vector (3,), rad."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())


def fit_motion(
    before: NDArray[np.float64], after: NDArray[np.float64], *, scaled: bool = False
) -> Motion | None:
    """Least-squares motion of markers (rows, cols, 3) m, a local bump left out of it.

    Markers without depth (z NaN) are fitted in the plane.  None where too few are known in both.
    Fitted again with the markers that fit best, as what touches the gel must not move the whole.
    """
    known = np.isfinite(before[..., :2]).all(axis=-1) & np.isfinite(after[..., :2]).all(axis=-1)
    flat = not (np.isfinite(before[..., 2]) & np.isfinite(after[..., 2]) & known).any()
    if not flat:
        known &= np.isfinite(before[..., 2]) & np.isfinite(after[..., 2])
    if np.count_nonzero(known) < LEAST_MARKERS:
        return None
    a, b = before[known].copy(), after[known].copy()
    if flat:
        a[:, 2] = b[:, 2] = 0.0
    off = np.empty(a.shape)
    R, scale, shift, centre = _fit(
        a, b, max(LEAST_MARKERS, round(KEPT_SHARE * len(a))), scaled, off
    )
    middle = a.mean(axis=0)
    shift = shift + centre + scale * R @ (middle - centre) - middle
    residual = np.full(before.shape, np.nan)
    if flat:
        off[:, 2] = shift[2] = np.nan
    residual[known] = off
    return Motion(shift, R, scale, residual)


def similarity(
    a: NDArray[np.float64], b: NDArray[np.float64], *, scaled: bool
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Rotation, scale and shift of the centre that bring points (N, 3) a nearest to b.

    Closed form: Umeyama, IEEE PAMI 13(4), 1991.  scaled: else the scale is 1.
    """
    used = np.ones(len(a), np.bool_)
    return _similarity(np.ascontiguousarray(a), np.ascontiguousarray(b), used, scaled)[:3]


@njit(cache=True, nogil=True, error_model="numpy")
def _similarity(
    a: Array, b: Array, used: NDArray[np.bool_], scaled: bool
) -> tuple[Array, float, Array, Array]:
    """As `similarity`, of the points that are used; and the centre (3,) of a."""
    centre_a, centre_b, count = np.zeros(3), np.zeros(3), 0
    for n in range(len(a)):
        if used[n]:
            centre_a += a[n]
            centre_b += b[n]
            count += 1
    centre_a /= count
    centre_b /= count
    product, spread = np.zeros((3, 3)), 0.0
    for n in range(len(a)):
        if used[n]:
            for j in range(3):
                da = a[n, j] - centre_a[j]
                spread += da * da
                for i in range(3):
                    product[i, j] += (b[n, i] - centre_b[i]) * da
    U, S, Vt = np.linalg.svd(product)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, 2], S[2] = -U[:, 2], -S[2]
    scale = S.sum() / spread if scaled and spread > 0 else 1.0
    return U @ Vt, scale, centre_b - centre_a, centre_a


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(
    a: Array, b: Array, keep: int, scaled: bool, off: Array
) -> tuple[Array, float, Array, Array]:
    """Similarity of the points that it fits best, as `_similarity`; fill off (N, 3), what is left.

    keep: so many points.
    """
    used = np.ones(len(a), np.bool_)
    square = np.empty(len(a))
    for _ in range(ROUNDS):
        R, scale, shift, centre = _similarity(a, b, used, scaled)
        for n in range(len(a)):
            square[n] = 0.0
            for i in range(3):
                turned = 0.0
                for j in range(3):
                    turned += R[i, j] * (a[n, j] - centre[j])
                off[n, i] = b[n, i] - (centre[i] + shift[i] + scale * turned)
                square[n] += off[n, i] ** 2
        used[:] = False
        used[np.argsort(square, kind="mergesort")[:keep]] = True
    return R, scale, shift, centre


def local_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each marker's values (rows, cols, 2 or 3) and its eight neighbours'.

    NaN where fewer than five of the nine are known (four at the rim); z, where never known, is 0.
    """
    mean = np.empty(values.shape)
    _average(np.ascontiguousarray(values, dtype=np.float64), mean)
    return mean


@njit(cache=True, nogil=True, error_model="numpy")
def _average(values: Array, mean: Array) -> None:
    """Fill mean as `local_mean` has it."""
    rows, cols, axes = values.shape
    for i in range(rows):
        for j in range(cols):
            mean[i, j] = 0.0
            count = 0
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    if math.isfinite(values[k, m, 0]) and math.isfinite(values[k, m, 1]):
                        count += 1
                        for axis in range(axes):
                            value = values[k, m, axis]
                            mean[i, j, axis] += 0.0 if math.isnan(value) else value
            at_rim = i == 0 or j == 0 or i == rows - 1 or j == cols - 1
            enough = count >= (LEAST_NEIGHBOURS - 1 if at_rim else LEAST_NEIGHBOURS)
            for axis in range(axes):
                mean[i, j, axis] = mean[i, j, axis] / count if enough else math.nan


def largest_local_mean(values: NDArray[np.float64]) -> float:
    """Length of the longest of the local means of values (rows, cols, 2 or 3); NaN without any."""
    lengths = np.linalg.norm(local_mean(values), axis=-1)
    return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else math.nan
