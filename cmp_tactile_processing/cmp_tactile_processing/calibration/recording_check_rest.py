"""How the gel at rest lies in a recording, against its nominal surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.gel_observation import local_mean

__all__ = ["RigidDrift", "rest_frames", "rigid_drift"]

FEWEST_CORNERS = 6


@dataclass(frozen=True)
class RigidDrift:
    """The measured surface is the nominal one, turned by `turn` (3,) rad about the apex, grown by
    `growth` and shifted by `shift` (3,) m; what is left is `residual` (rows, cols, k) m.

    One view tells a turn about z and shifts along x and y alone, with k = 2; the rest is 0.
    """

    turn: NDArray[np.float64]
    shift: NDArray[np.float64]
    growth: float
    residual: NDArray[np.float64]

    @property
    def shape_peak(self) -> float:
        """The largest residual, averaged over 3 x 3 corners, m."""
        lengths = np.linalg.norm(local_mean(self.residual), axis=-1)
        return float(np.nanmax(lengths)) if np.isfinite(lengths).any() else float("inf")


def rigid_drift(position: NDArray[np.float64], nominal: NDArray[np.float64]) -> RigidDrift | None:
    """Best similarity from nominal (rows, cols, 3) to measured positions, gel frame, m.

    z of `position` is NaN for one view.  None where fewer than six corners are known.
    Closed form of Umeyama (IEEE PAMI 13(4), 1991).
    """
    dims = 2 if np.isnan(position[..., 2]).all() else 3
    known = np.isfinite(position[..., :dims]).all(axis=-1)
    if int(known.sum()) < FEWEST_CORNERS:
        return None
    p, q = nominal[known][:, :dims], position[known][:, :dims]
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    U, S, Vt = np.linalg.svd((q - q_mean).T @ (p - p_mean))
    signs = np.ones(dims)
    signs[-1] = np.sign(np.linalg.det(U @ Vt))
    R = (U * signs) @ Vt
    scale = float((S * signs).sum() / ((p - p_mean) ** 2).sum())
    t = q_mean - scale * R @ p_mean
    fitted = scale * nominal[..., :dims] @ R.T + t
    turn, shift = np.zeros(3), np.zeros(3)
    shift[:dims] = t
    if dims == 2:
        turn[2] = np.arctan2(R[1, 0], R[0, 0])
    else:
        turn = _rotation_vector(R)
    return RigidDrift(turn, shift, scale - 1, position[..., :dims] - fitted)


def rest_frames(
    positions: NDArray[np.float64],
    nominal: NDArray[np.float64],
    still: NDArray[np.bool_],
    limit: float,
) -> NDArray[np.intp]:
    """Which frames (F, rows, cols, 3) m show the gel at rest.

    Those that are still (F,), with the rest shape when that is moved and grown as a whole; limit:
    m, of what is left then.
    """
    found = []
    for number in np.flatnonzero(still):
        drift = rigid_drift(positions[number], nominal)
        if drift is not None and drift.shape_peak <= limit:
            found.append(number)
    return np.array(found, dtype=np.intp)


def _rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(Rotation.from_matrix(R).as_rotvec())
