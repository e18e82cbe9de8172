"""How the gel at rest lies in a recording, against its nominal surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.rigid_motion import largest_local_mean, similarity

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
        largest = largest_local_mean(self.residual)
        return math.inf if math.isnan(largest) else largest


def rigid_drift(position: NDArray[np.float64], nominal: NDArray[np.float64]) -> RigidDrift | None:
    """Best similarity from nominal (rows, cols, 3) to measured positions, gel frame, m.

    z of `position` is NaN for one view.  None where fewer than six corners are known.
    """
    dims = 2 if np.isnan(position[..., 2]).all() else 3
    known = np.isfinite(position[..., :dims]).all(axis=-1)
    if int(known.sum()) < FEWEST_CORNERS:
        return None
    flat = np.array([1.0, 1.0, float(dims == 3)])
    p, q = nominal[known] * flat, np.nan_to_num(position[known]) * flat
    R, scale, moved = similarity(p, q, scaled=True)
    middle = p.mean(axis=0)
    shift = middle + moved - scale * R @ middle
    fitted = scale * (nominal * flat) @ R.T + shift
    turn = Rotation.from_matrix(R).as_rotvec()
    return RigidDrift(turn, shift, scale - 1, (position - fitted)[..., :dims])


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
