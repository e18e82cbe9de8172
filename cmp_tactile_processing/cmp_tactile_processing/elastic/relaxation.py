"""Relaxation of the gel: the displacement that its force is proportional to, frame by frame.

A gel that is held yields: with one Prony term, common to all components (Poisson's ratio stays),
its modulus t seconds after a step is E(t) = young (1 - share + share exp(-t / time)).  The force
follows by superposition of all earlier steps, and as it is linear in the displacement u,

    force(t) = K (u(t) - share q(t)),    dq/dt = (u - q) / time,

where K is the elastic stiffness with the instantaneous modulus `young`, and q is u as the gel
remembers it.  So an elastic inverse of u - share q gives the true force.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.sensor.parts import GelRelaxation

LOGGER = logging.getLogger(__name__)

Array = NDArray[np.float64]


class RelaxationFilter:
    """Takes the relaxation of a gel out of its displacement.

    Exact for displacements that are straight lines in time between frames, whatever the frames'
    distance; noise is not amplified.  It begins as if the first displacement had been there for
    long: where nothing moves, nothing drifts, but a contact made shortly before is shown by up to
    `share` too weak, and one that ends then by as much of it as a pull, until `time` has passed.
    """

    def __init__(self, relaxation: GelRelaxation) -> None:
        self.relaxation = relaxation
        self._warned = False
        self.reset()

    def reset(self) -> None:
        """Forget earlier frames, as after start-up: needed where the reference changes."""
        self._stamp_ns: int | None = None
        self._last: Array = np.zeros((0, 0, 3))
        self._lag: Array = np.zeros((0, 0, 3))
        self._unseen_s: Array = np.zeros((0, 0, 3))

    def effective(
        self, displacement: Array, status: NDArray[np.uint8], stamp_ns: int | None
    ) -> Array:
        """The displacement (rows, cols, 3) m that an elastic gel shows under the same force.

        displacement (rows, cols, 3) m, status (rows, cols): markers of status 0 and components
        that are NaN are missing and stay as they are.  One that comes back is taken to have moved
        in a straight line meanwhile; one that is seen for the first time, to have moved when the
        others did.
        stamp_ns: of the frame; without it the displacement is returned as it is, and the frame
        does not count.  A stamp before the last one starts over, the same stamp replaces the frame.
        Raises CmpTactileError for arrays of wrong or changing shape.
        """
        moved = np.asarray(displacement, dtype=np.float64)
        states = np.asarray(status)
        self._check(moved, states)
        if stamp_ns is None:
            if not self._warned:
                LOGGER.warning(
                    "found frames without a stamp: the relaxation of the gel is not corrected"
                )
            self._warned = True
            return moved
        seen = np.isfinite(moved) & (states != 0)[..., None]
        if self._stamp_ns is not None and stamp_ns < self._stamp_ns:
            LOGGER.info(
                "time went back by %.3f s: the correction of the relaxation starts again",
                (self._stamp_ns - stamp_ns) * 1e-9,
            )
            self.reset()
        if self._stamp_ns is None:
            self._begin(moved, seen)
        else:
            self._go_on(moved, seen, (stamp_ns - self._stamp_ns) * 1e-9)
        self._stamp_ns = stamp_ns
        return np.asarray(np.where(seen, moved - self.relaxation.share * self._lag, moved))

    def _begin(self, moved: Array, seen: NDArray[np.bool_]) -> None:
        self._last = np.where(seen, moved, np.nan)
        self._lag = self._last.copy()
        self._unseen_s = np.zeros_like(moved)

    def _go_on(self, moved: Array, seen: NDArray[np.bool_], elapsed_s: float) -> None:
        self._unseen_s += elapsed_s
        kept, before, now = step_weights(self._unseen_s / self.relaxation.time)
        lag = kept * self._lag + before * self._last + now * moved
        new = seen & np.isnan(lag)
        if new.any():
            lag[new] = _remembered_share(lag, moved, seen & ~new) * moved[new]
        self._lag = np.where(seen, lag, self._lag)
        self._last = np.where(seen, moved, self._last)
        self._unseen_s[seen] = 0.0

    def _check(self, moved: Array, states: NDArray[np.uint8]) -> None:
        if moved.ndim != 3 or moved.shape[2] != 3:
            msg = f"displacement: found shape {moved.shape}, expected (rows, cols, 3)"
            raise CmpTactileError(msg)
        if states.shape != moved.shape[:2]:
            msg = f"status: found shape {states.shape}, expected {moved.shape[:2]}"
            raise CmpTactileError(msg)
        if self._stamp_ns is not None and moved.shape != self._last.shape:
            msg = f"displacement: found shape {moved.shape}, expected {self._last.shape} as before"
            raise CmpTactileError(msg)


def step_weights(steps: Array) -> tuple[Array, Array, Array]:
    """Weights of lag, value before and value now in the lag after steps, in time constants.

    The exact solution of dq/dt = u - q where u is a straight line over each step; they add up
    to 1.
    """
    steps = np.asarray(steps, dtype=np.float64)
    kept = np.exp(-steps)
    # Mean of exp(-s) over the step; 1 for one of no length.
    mean = np.where(steps > 0, -np.expm1(-steps) / np.where(steps > 0, steps, 1.0), 1.0)
    return kept, mean - kept, 1.0 - mean


def _remembered_share(lag: Array, moved: Array, known: NDArray[np.bool_]) -> float:
    """How much of the present displacement the gel remembers, as far as known markers show."""
    size = float((moved[known] ** 2).sum())
    if size == 0.0:
        return 1.0
    return float(np.clip((lag[known] * moved[known]).sum() / size, 0.0, 1.0))
