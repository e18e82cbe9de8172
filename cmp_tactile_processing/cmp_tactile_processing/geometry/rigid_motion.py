"""The rigid motion, with a scale if wanted, that brings one set of markers onto another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array: TypeAlias = NDArray[np.float64]

# Share of the markers that a contact leaves where they were, and rounds to find them.
KEPT_SHARE = 0.7
ROUNDS = 4
# Fewer markers do not separate a motion from their noise.
LEAST_MARKERS = 6
# Markers of a local mean: one and its eight neighbours; so many of them must be known.
NEIGHBOURS = 9
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
    R, scale, shift, centre, off = _fit(
        a, b, max(LEAST_MARKERS, round(KEPT_SHARE * len(a))), scaled
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
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    from_centre = a - centre_a
    U, S, Vt = np.linalg.svd((b - centre_b).T @ from_centre)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, -1], S[-1] = -U[:, -1], -S[-1]
    spread = float((from_centre**2).sum())
    scale = float(S.sum()) / spread if scaled and spread > 0 else 1.0
    return U @ Vt, scale, centre_b - centre_a


def _fit(a: Array, b: Array, keep: int, scaled: bool) -> tuple[Array, float, Array, Array, Array]:
    """Similarity of the `keep` points (N, 3) that it fits best, their centre, what is left (N, 3).

    The shift is that of the centre.
    """
    used = np.arange(len(a))
    for _ in range(ROUNDS):
        R, scale, shift = similarity(a[used], b[used], scaled=scaled)
        centre = a[used].mean(axis=0)
        off = b - (centre + shift + scale * (a - centre) @ R.T)
        used = np.argsort((off**2).sum(axis=1), kind="stable")[:keep]
    return R, scale, shift, centre, off


def local_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of each marker's values (rows, cols, 2 or 3) and its eight neighbours'.

    NaN where fewer than five of the nine are known (four at the rim); z, where never known, is 0.
    """
    known = np.logical_and(*np.isfinite(np.moveaxis(values[..., :2], -1, 0)))
    count = _sum_around(known.astype(np.float64))
    least = np.full(known.shape, LEAST_NEIGHBOURS)
    least[[0, -1]] = least[:, [0, -1]] = LEAST_NEIGHBOURS - 1
    values = np.nan_to_num(values, nan=0.0)
    values[~known] = 0.0
    count[count < least] = np.nan
    return _sum_around(values) / count[..., None]


def _sum_around(values: Array) -> Array:
    """Sum of each marker's values (rows, cols[, d]) and its eight neighbours'."""
    return np.asarray(cv2.filter2D(values, -1, np.ones((3, 3)), borderType=cv2.BORDER_CONSTANT))


def largest_local_mean(values: NDArray[np.float64]) -> float:
    """Length of the longest of the local means of values (rows, cols, 2 or 3); NaN without any."""
    lengths = np.linalg.norm(local_mean(values), axis=-1)
    return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else math.nan
