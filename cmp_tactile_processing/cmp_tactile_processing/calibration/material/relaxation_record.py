"""A record of a load that is put on a gel and held: what is read, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError

__all__ = ["LoadRecord"]

Array = NDArray[np.float64]

FEWEST_SAMPLES = 30
# A weight rests where the reading is above this share of its highest, and this long after it came.
LOADED_SHARE, SETTLE_S = 0.5, 0.3
# Below this share of the highest reading the gel counts as untouched.
UNTOUCHED_SHARE = 0.03


@dataclass(frozen=True)
class LoadRecord:
    """A checked record of a load on a gel.

    force (n,): the reference, NaN where it is not known; known (n,): where it is.
    highest: reading, N.  held_s: how long the gel was loaded.  sample_s: between samples.
    has_offset: whether the gel at rest tells an offset of the reference.
    """

    time: Array
    reading: Array
    known: NDArray[np.bool_]
    force: Array
    highest: float
    held_s: float
    sample_s: float
    has_offset: bool

    def predicted(self, stiffness: float, offset: float, terms: Array) -> Array:
        """What would be read where the reference counts, of a gel that relaxes, (known,) N.

        stiffness: read over true force of a quick press.  offset: of the reference, N.
        terms (2, k): shares and time constants, s.
        """
        read = _predicted(self.time, self.force - offset, self.reading, stiffness, terms)
        return np.asarray(read[self.known])

    @classmethod
    def from_readings(
        cls, time_s: Array, reading: Array, reference: Array | float | None
    ) -> LoadRecord:
        """The record of what `fit_relaxation` takes, with its errors."""
        time, shown, force = _checked(time_s, reading, reference)
        highest = float(np.abs(shown).max())
        loaded = np.abs(shown) > LOADED_SHARE * highest
        if reference is None or np.ndim(reference) == 0:
            force[_resting(time, loaded)] = 1.0 if reference is None else float(reference)
        known = np.isfinite(force)
        if known.sum() < FEWEST_SAMPLES or not force[known].any():
            msg = (
                f"samples at rest under a known load: found {int(known.sum())}, expected at least "
                f"{FEWEST_SAMPLES}, the load not 0 throughout"
            )
            raise CalibrationError(msg)
        steps = np.diff(time)
        untouched = known & (np.abs(shown) < UNTOUCHED_SHARE * highest)
        return cls(
            time=time,
            reading=shown,
            known=known,
            force=force,
            highest=highest,
            held_s=float(steps[loaded[1:] & known[1:]].sum()),
            sample_s=float(np.median(steps)),
            has_offset=bool(untouched.sum() >= FEWEST_SAMPLES // 3),
        )


def _checked(
    time_s: Array, reading: Array, reference: Array | float | None
) -> tuple[Array, Array, Array]:
    """Times, readings and reference (NaN for a weight) where there are readings."""
    time, shown = np.asarray(time_s, dtype=np.float64), np.asarray(reading, dtype=np.float64)
    if time.ndim != 1 or shown.shape != time.shape:
        msg = f"reading: found shape {shown.shape} at times {time.shape}, expected (n,) both"
        raise CalibrationError(msg)
    force = np.full(time.shape, np.nan)
    if reference is not None and np.ndim(reference) > 0:
        force = np.asarray(reference, dtype=np.float64)
        if force.shape != time.shape:
            msg = f"reference: found shape {force.shape}, expected {time.shape}"
            raise CalibrationError(msg)
    seen = np.isfinite(shown) & np.isfinite(time)
    time, shown, force = time[seen], shown[seen], force[seen]
    if len(time) < FEWEST_SAMPLES:
        msg = f"reading: found {len(time)} samples, expected at least {FEWEST_SAMPLES}"
        raise CalibrationError(msg)
    if (np.diff(time) <= 0).any():
        msg = f"time_s: found {time[np.argmin(np.diff(time)) + 1]:g} s after a later time"
        raise CalibrationError(f"{msg}, expected growing times")
    if not shown.any():
        msg = "reading: found 0 throughout, expected a load"
        raise CalibrationError(msg)
    return time, shown, force


def _resting(time: Array, loaded: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The longest stretch of loaded samples, without its ends."""
    edges = np.flatnonzero(np.diff(np.r_[False, loaded, False].astype(np.int8)))
    begins, ends = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(time[ends] - time[begins]))
    begin, end = time[begins[longest]], time[ends[longest]]
    last = end if ends[longest] == len(time) - 1 else end - SETTLE_S
    return np.asarray((time >= begin + SETTLE_S) & (time <= last))


@njit(cache=True, nogil=True, error_model="numpy")
def _predicted(time: Array, force: Array, reading: Array, stiffness: float, terms: Array) -> Array:
    """Readings (n,) N: from the force alone, and as they are where that is NaN.

    What the gel remembers follows from what is predicted, not from what is read: noise that was
    read would seem to be remembered.  Readings are straight lines between samples.
    """
    count = terms.shape[1]
    lag = np.zeros(count)
    read = np.empty(len(time))
    for n in range(len(time)):
        held, own = 0.0, 0.0
        for k in range(count):
            share, now = terms[0, k], 0.0
            if n > 0:
                step = (time[n] - time[n - 1]) / terms[1, k]
                kept = np.exp(-step)
                mean = -np.expm1(-step) / step
                now = 1.0 - mean
                lag[k] = kept * lag[k] + (mean - kept) * read[n - 1]
            held += share * lag[k]
            own += share * now
        # read = stiffness force + sum of share lag, and a part of the lag is of that reading.
        if np.isnan(force[n]):
            read[n] = reading[n]
        else:
            read[n] = (stiffness * force[n] + held) / (1.0 - own)
        if n > 0:
            for k in range(count):
                step = (time[n] - time[n - 1]) / terms[1, k]
                lag[k] += (1.0 + np.expm1(-step) / step) * read[n]
    return read
