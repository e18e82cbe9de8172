"""A record of a load that is put on a gel and held: what is read, and what is known of it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.relaxation import step_weights

__all__ = ["LoadRecord"]

Array = NDArray[np.float64]

FEWEST_SAMPLES = 30
# A weight rests where the reading is above this share of its highest, and this long after it came.
LOADED_SHARE, SETTLE_S = 0.5, 0.3
# Below this share of the highest reading the gel counts as untouched.
UNTOUCHED_SHARE = 0.03
# Time constants are looked for from so many samples' distances to so many lengths of the record.
SHORTEST_STEPS, LONGEST_RECORDS = 1.0, 5.0
# Of two noises, the lesser is taken as this share of the other at least, and either as this share
# of the signal.
LEAST_NOISE_RATIO, LEAST_NOISE = 1e-2, 1e-9


@dataclass(frozen=True)
class LoadRecord:
    """A checked record of a load on a gel.

    known (n,): where the reference counts; force, read: reference and reading there, and their
    noise, N.
    """

    time: Array
    reading: Array
    known: NDArray[np.bool_]
    force: Array
    read: Array
    force_noise: float
    read_noise: float
    highest: float
    held_s: float
    sample_s: float
    longest: float
    has_offset: bool

    def times(self, count: int) -> Array:
        """Time constants to try, s."""
        shortest = SHORTEST_STEPS * self.sample_s
        return np.geomspace(shortest, max(self.longest, 2 * shortest), count)

    def lags(self, times: Array) -> Array:
        """What the gel remembers of the reading with each of the time constants, (m, known), N."""
        kept, before, now = step_weights(np.diff(self.time)[:, None] / times)
        given = before * self.reading[:-1, None] + now * self.reading[1:, None]
        lags = np.zeros((len(self.reading), len(times)))
        for k in range(len(given)):
            lags[k + 1] = kept[k] * lags[k] + given[k]
        return np.ascontiguousarray(lags[self.known].T)

    @classmethod
    def of(cls, time_s: Array, reading: Array, reference: Array | float | None) -> LoadRecord:
        """The record of what `fit_relaxation` takes, with its errors."""
        time, shown, force = _checked(time_s, reading, reference)
        highest = float(np.abs(shown).max())
        loaded = np.abs(shown) > LOADED_SHARE * highest
        if reference is None or np.ndim(reference) == 0:
            force[_resting(time, loaded)] = 1.0 if reference is None else float(reference)
        known = np.isfinite(force)
        if known.sum() < FEWEST_SAMPLES or not force[known].any():
            msg = f"reference: found {int(known.sum())} samples of a known load, expected at least"
            raise CalibrationError(f"{msg} {FEWEST_SAMPLES}, not all 0")
        steps = np.diff(time)
        ratio = float(np.abs(force[known]).max()) / highest
        untouched = known & (np.abs(shown) < UNTOUCHED_SHARE * highest)
        return cls(
            time=time,
            reading=shown,
            known=known,
            force=force[known],
            read=shown[known],
            force_noise=max(_noise(force), LEAST_NOISE_RATIO * _noise(shown) * ratio),
            read_noise=max(_noise(shown), LEAST_NOISE_RATIO * _noise(force) / ratio),
            highest=highest,
            held_s=float(steps[loaded[1:] & known[1:]].sum()),
            sample_s=float(np.median(steps)),
            longest=LONGEST_RECORDS * float(time[-1] - time[0]),
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


def _noise(values: Array) -> float:
    """Standard deviation of the noise of values, of which some are NaN, from second differences."""
    second = np.diff(values, 2)
    second = second[np.isfinite(second)]
    least = LEAST_NOISE * float(np.nanmax(np.abs(values)))
    if len(second) == 0:
        return least
    # 1.4826: from the median to the standard deviation of normal noise.
    return max(1.4826 * float(np.median(np.abs(second))) / math.sqrt(6), least)
