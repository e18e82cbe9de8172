"""Relaxation of a gel from the record of a load: how much of its modulus fades, and how fast.

The record begins with the gel untouched and recovered; then it is loaded, at best within a
moment, and held.  An elastic inverse reads a force g from its displacement, which differs from
the force F on the gel by what the gel gives up:

    F(t) = scale (g(t) - share q(t)) + offset,    dq/dt = (g - q) / time.

Either F is known at each time, as from a force sensor, while g or F changes, or F is a weight and
g creeps.  The fit predicts g from F and compares the two: a fit of F from g would take noise in g
for relaxation, as its past is in q.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, least_squares

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.calibration.outcome import Finding, Severity, WithFindings, errors_in
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.sensor.parts import GelRelaxation

# How much better a term must make the fit, in variances, to be believed: its time constant was
# looked for, so that noise alone gets to 15 in one record of 1,000.
SIGNIFICANT = 20.0
# Readings at the beginning above this share of the highest are a gel that was loaded before.
STARTS_LOADED, STARTS_TOUCHED = 0.1, 0.03
# Time constants for which a load should be held.
HELD_WANTED = 3.0
# Relative standard deviations above which a value is of no use.
USELESS_SHARE, USELESS_TIME = 0.3, 0.5
# Residuals that are correlated over more samples than those of noise, and larger than this share of
# the highest reading, are not those of one time constant.
HANGS_TOGETHER, MISFIT_SHARE = 3.0, 0.001
BELIEVED_SHARE = 0.95
# Samples within a time constant that it takes to see it.
SAMPLES_WANTED = 3.0

FEWEST_SAMPLES = 30
# A weight rests where the reading is above this share of its highest, and this long after it came.
LOADED_SHARE, SETTLE_S = 0.5, 0.3
# Below this share of the highest reading the gel counts as untouched.
UNTOUCHED_SHARE = 0.03

# Time constants are looked for from so many samples' distances to so many lengths of the record,
# from so many starts; beyond AT_LONGEST of the longest it is not known.
SHORTEST_STEPS, LONGEST_RECORDS, STARTS, AT_LONGEST = 1.0, 5.0, 5, 0.98
# The share is looked for in these limits, from here; below 0 is what nothing that relaxes does.
LEAST_SHARE, MOST_SHARE, FIRST_SHARE = -1.0, 0.97, 0.1
# Of a relaxation that is not seen: the length of the hold over the time constant to name, and
# standard deviations of the share that would have been seen.
USUAL_HOLD, SEEN = 5.0, 3.0
# Of one search.
MOST_EVALUATIONS = 60
Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoadRecord:
    """A checked record of a load on a gel.

    force (n,): the reference, NaN where it is not known; known (n,): where it is.
    highest: reading, N.  held_s: how long the gel was loaded.  sample_s: between samples.
    has_offset: whether the gel at rest shows an offset of the reference.
    """

    time: Array
    reading: Array
    known: NDArray[np.bool_]
    force: Array
    highest: float
    held_s: float
    sample_s: float
    has_offset: bool

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
                f"samples under a known load: found {int(known.sum())}, expected at least "
                f"{FEWEST_SAMPLES}, and a load that is not always 0"
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


@kernel
def _predicted(time: Array, force: Array, reading: Array, stiffness: float, term: Array) -> Array:
    """Readings (n,) N: from the force alone, and as they are where that is NaN.

    What the gel remembers follows from what is predicted, not from what is read: noise that was
    read would seem to be remembered.  Readings are straight lines between samples.
    term: share, and time constant, s.
    """
    share, tau = term
    lag = 0.0
    read = np.empty(len(time))
    for n in range(len(time)):
        of_now = 0.0
        if n > 0:
            step = (time[n] - time[n - 1]) / tau
            kept = np.exp(-step)
            mean = -np.expm1(-step) / step
            of_now = 1.0 - mean
            lag = kept * lag + (mean - kept) * read[n - 1]
        # read = stiffness force + share lag, and a part of the lag is of that reading.
        if np.isnan(force[n]):
            read[n] = reading[n]
        else:
            read[n] = (stiffness * force[n] + share * lag) / (1.0 - share * of_now)
        lag += of_now * read[n]
    return read


@dataclass(frozen=True)
class RelaxationOutcome(WithFindings):
    """What a record shows of a gel's relaxation.

    relaxation: None where there is none to be seen, or the record cannot show it.
    share_std, time_std (s): standard deviations, with the noise as correlated in time as the
    residuals are.
    scale, scale_std: true over read force of a quick press, so that `young` times it is the
    instantaneous modulus; NaN where the load is not known.
    residual: RMS of what is left of the force, as a share of the highest.
    verdict: a sentence or two for people.
    """

    relaxation: GelRelaxation | None
    share_std: float
    time_std: float
    scale: float
    scale_std: float
    residual: float
    findings: tuple[Finding, ...]
    verdict: str


def fit_relaxation(
    time_s: Array, reading: Array, reference: Array | float | None = None
) -> RelaxationOutcome:
    """Fit one Prony term to a record.

    time_s (n,): s, growing.  reading (n,) N: one component of the force, or its size with a sign,
    of the elastic inverse with relaxation left out; NaN where there was none.
    reference: the true force (n,) N in the same direction, NaN where it is not known; or the
    weight that rests on the gel, N, one number; None for a weight that is not known.  How the
    weight is put down may be as rough as it likes, and need not be known.
    Raises CalibrationError for records that are not of this form.
    """
    record = LoadRecord.from_readings(time_s, reading, reference)
    elastic, fit = _elastic(record), _best(record)
    # Where there is nothing to be seen the time constant is anything: what would have been seen.
    least = elastic.std(record)
    significance = fit.better_than(elastic)
    seen = significance >= SIGNIFICANT and 0 < fit.share < BELIEVED_SHARE
    findings = _start_findings(record)
    if significance < SIGNIFICANT:
        findings.append(_unseen_finding(record, SEEN * least.share))
    elif not seen:
        findings.append(_unbelieved_finding(fit))
    else:
        findings += _time_findings(record, fit)
        findings += _misfit_findings(record, fit)
    chosen, spread = (fit, fit.std(record)) if seen else (elastic, least)
    scale = 1 / chosen.stiffness if reference is not None else math.nan
    found = RelaxationOutcome(
        relaxation=GelRelaxation(fit.share, fit.time) if seen else None,
        share_std=spread.share,
        time_std=spread.time if seen else math.nan,
        scale=scale,
        scale_std=spread.stiffness * scale**2,
        residual=chosen.rms / record.highest,
        findings=tuple(findings),
        verdict="",
    )
    return replace(found, verdict=_verdict(found, SEEN * least.share))


@dataclass(frozen=True)
class _Deviations:
    """Standard deviations of a fit."""

    stiffness: float
    share: float
    time: float


@dataclass(frozen=True)
class _Fit:
    """Parameters of the prediction, and read minus predicted (known,) N."""

    stiffness: float
    share: float
    time: float
    offset: float
    residuals: Array

    @classmethod
    def at(cls, values: Array, record: LoadRecord) -> _Fit:
        """From stiffness, share, logarithm of the time and, where the record shows it, offset."""
        stiffness, share, log = (float(value) for value in values[:3])
        offset = float(values[3]) if record.has_offset else 0.0
        term = np.array([share, math.exp(log)])
        read = _predicted(record.time, record.force - offset, record.reading, stiffness, term)
        residuals = (record.reading - read)[record.known]
        return cls(stiffness, share, math.exp(log), offset, residuals)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, N."""
        return float(np.sqrt((self.residuals**2).mean()))

    @property
    def variance(self) -> float:
        """Of a residual, times how many of them say as much as one that is independent."""
        return self.rms**2 * _correlated_samples(self.residuals)

    def better_than(self, other: _Fit) -> float:
        """By how many variances the squares are less than those of another fit."""
        gained = float(other.residuals @ other.residuals - self.residuals @ self.residuals)
        return gained / self.variance if self.variance > 0 else math.inf

    def std(self, record: LoadRecord) -> _Deviations:
        """Standard deviations, of noise that is correlated as the residuals are."""
        values = np.array([self.stiffness, self.share, math.log(self.time), self.offset])
        values = values[: 4 if record.has_offset else 3]
        jacobian = approx_fprime(values, lambda v: _Fit.at(v, record).residuals)
        if self.share == 0:
            # Without a share nothing shows the time constant: it is taken as known.
            jacobian[:, 2] = 0.0
        covariance = self.variance * np.linalg.pinv(jacobian.T @ jacobian)
        stiffness, share, log = np.sqrt(np.maximum(np.diag(covariance)[:3], 0.0)).tolist()
        return _Deviations(stiffness, share, self.time * log)


def _time_limits(record: LoadRecord) -> tuple[float, float]:
    whole = float(record.time[-1] - record.time[0])
    return SHORTEST_STEPS * record.sample_s, LONGEST_RECORDS * whole


def _elastic(record: LoadRecord) -> _Fit:
    """The best fit of a gel that does not relax, by linear least squares."""
    force, read = record.force[record.known], record.reading[record.known]
    columns = [force, np.ones_like(force)] if record.has_offset else [force]
    line = np.linalg.lstsq(np.stack(columns, axis=1), read, rcond=None)[0]
    usual = math.log(record.held_s / USUAL_HOLD)
    return _Fit.at(np.array([line[0], 0.0, usual, *(-line[1:] / line[0])]), record)


def _best(record: LoadRecord) -> _Fit:
    """The best fit with one time constant, which is looked for from several starts."""
    force, read = record.force[record.known], record.reading[record.known]
    stiffness = float(read @ force) / float(force @ force)
    low, high = np.log(_time_limits(record))
    count = 4 if record.has_offset else 3
    bounds = (
        [-np.inf, LEAST_SHARE, low, -np.inf][:count],
        [np.inf, MOST_SHARE, high, np.inf][:count],
    )
    searches = [
        least_squares(
            lambda v: _Fit.at(v, record).residuals,
            [stiffness, FIRST_SHARE, start, 0.0][:count],
            bounds=bounds,
            x_scale=[abs(stiffness), 0.1, 1.0, 0.1 * record.highest][:count],
            max_nfev=MOST_EVALUATIONS,
        )
        for start in np.linspace(low, high, STARTS + 2)[1:-1]
    ]
    return _Fit.at(min(searches, key=lambda found: float(found.cost)).x, record)


def _correlated_samples(residuals: Array) -> float:
    """How many samples say as much as one that is independent: the autocorrelation's integral.

    Summed until it first comes to 0.
    """
    centred = residuals - residuals.mean()
    power = float(centred @ centred)
    if power == 0:
        return 1.0
    size = 2 ** math.ceil(math.log2(2 * len(centred)))
    spectrum = np.fft.rfft(centred, size)
    correlation = np.fft.irfft(spectrum * spectrum.conj(), size)[: len(centred)] / power
    ends = np.flatnonzero(correlation <= 0)
    end = int(ends[0]) if len(ends) else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(correlation[1:end].sum()))


def _start_findings(record: LoadRecord) -> list[Finding]:
    at_start = abs(float(record.reading[0])) / record.highest
    if at_start < STARTS_TOUCHED:
        return []
    loaded = at_start > STARTS_LOADED
    text = f"The record begins with {at_start:.0%} of the highest reading"
    text += ": the earlier load is not known." if loaded else "."
    advice = (
        "Begin the record while nothing touches the gel, after it has recovered from the last "
        "contact."
    )
    return [Finding.graded(text, advice, error=loaded)]


def _unseen_finding(record: LoadRecord, least_share: float) -> Finding:
    text = (
        f"No relaxation was found in {record.held_s:.3g} s of load: its share is below "
        f"{least_share:.2g}."
    )
    advice = (
        "If the force still drifts, hold a larger load for longer, and begin the record before "
        "the load."
    )
    return Finding(Severity.WARNING, text, advice)


def _unbelieved_finding(fit: _Fit) -> Finding:
    text = (
        f"The fit gives a share of {fit.share:.2g}: the measured force changes in the opposite "
        "direction to that of a relaxing gel."
    )
    advice = (
        "Check that reading and reference have the same sign and clock and are not swapped, and "
        "that the reference does not drift."
    )
    return Finding(Severity.ERROR, text, advice)


_LONGER = f"Hold the load for {HELD_WANTED:g} time constants or more."


def _time_findings(record: LoadRecord, fit: _Fit) -> list[Finding]:
    """Is the record long and dense enough for its time constant?"""
    std, held_s = fit.std(record), record.held_s
    useless = (
        std.share > USELESS_SHARE * fit.share
        or std.time > USELESS_TIME * fit.time
        or fit.time >= AT_LONGEST * _time_limits(record)[1]
    )
    if useless:
        text = (
            f"A load of {held_s:.3g} s is too short to determine the relaxation: share "
            f"{fit.share:.2g} (std {std.share:.1g}), time constant {fit.time:.3g} s (std "
            f"{std.time:.1g} s)."
        )
        return [Finding(Severity.ERROR, text, _LONGER)]
    findings = []
    if held_s < HELD_WANTED * fit.time:
        text = (
            f"The load was held for {held_s:.3g} s, {held_s / fit.time:.2g} time constants: "
            "slower relaxation is not found."
        )
        findings.append(Finding(Severity.WARNING, text, _LONGER))
    if fit.time < SAMPLES_WANTED * record.sample_s:
        text = (
            f"One sample every {record.sample_s:.2g} s is too slow for a time constant of "
            f"{fit.time:.2g} s."
        )
        findings.append(Finding(Severity.WARNING, text, "Record at a higher rate."))
    return findings


def _misfit_findings(record: LoadRecord, fit: _Fit) -> list[Finding]:
    """Does one time constant describe the record?"""
    share = fit.rms / record.highest
    if _correlated_samples(fit.residuals) < HANGS_TOGETHER or share < MISFIT_SHARE:
        return []
    text = (
        "One time constant does not describe the gel: the remaining error of the force is "
        f"{share:.1%} of its maximum."
    )
    advice = "Fit a record of the length of your contacts."
    return [Finding(Severity.WARNING, text, advice)]


def _verdict(found: RelaxationOutcome, least_share: float) -> str:
    refused, relaxation = bool(errors_in(found.findings)), found.relaxation
    if relaxation is None:
        if refused:
            return "The record does not show how the gel relaxes."
        return f"The gel relaxes by less than {least_share:.2g} of its modulus."
    text = (
        f"Under a held load the gel loses {relaxation.share:.1%} (std {100 * found.share_std:.2g} "
        f"%) of its modulus with a time constant of {relaxation.time:.3g} s (std "
        f"{found.time_std:.2g} s)."
    )
    return f"{text} Do not use this result: see the findings." if refused else text
