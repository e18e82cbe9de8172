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
from scipy.optimize import least_squares

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
# Errors of the force, as shares of the highest, that a second term is worth a word for.
SECOND_MATTERS = 0.003
BELIEVED_SHARE = 0.95
# Samples within a time constant that it takes to see it.
SAMPLES_WANTED = 3.0

FEWEST_SAMPLES = 30
# A weight rests where the reading is above this share of its highest, and this long after it came.
LOADED_SHARE, SETTLE_S = 0.5, 0.3
# Below this share of the highest reading the gel counts as untouched.
UNTOUCHED_SHARE = 0.03
Array = NDArray[np.float64]

# Time constants are looked for from so many samples' distances to so many lengths of the record,
# from so many starts.
SHORTEST_STEPS, LONGEST_RECORDS, STARTS = 1.0, 5.0, 5
# The share is looked for in these limits, from here; below 0 is what nothing that relaxes does.
LEAST_SHARE, MOST_SHARE, FIRST_SHARE = -1.0, 0.97, 0.1
# Of a relaxation that is not seen: the length of the hold over the time constant to name.
USUAL_HOLD = 5.0
# Two terms are looked for from the one, split, at these ratios of its time constant.
SPLITS = ((0.3, 3.0), (0.1, 1.5), (0.7, 10.0))
# Residuals of noise alone are correlated over so few samples.
HANGS_TOGETHER = 1.2
# Of one search.
MOST_EVALUATIONS = 60
# Relative steps of derivatives.
DERIVATIVE_STEP = 1e-5


@dataclass(frozen=True)
class SecondTerm:
    """The best fit with two time constants.

    shares, times (s): of the two.  significance: how much better it is, in variances.  differs: the
    largest difference of force from the fit with one, as a share of the highest force.
    """

    shares: tuple[float, float]
    times: tuple[float, float]
    significance: float
    differs: float


@dataclass(frozen=True)
class Evidence:
    """What a fit is judged by.

    least_share: that would have been seen, of a time constant that suits the record.
    significance: how much better it is than none, in variances.  at_start: reading at the
    beginning over the highest.  held_s: how long the gel was loaded.  sample_s: distance of
    samples.  at_longest: the time constant is the longest that was tried.
    """

    share: float
    share_std: float
    least_share: float
    time: float
    time_std: float
    significance: float
    at_start: float
    held_s: float
    sample_s: float
    at_longest: bool
    second: SecondTerm | None


def relaxation_findings(evidence: Evidence) -> tuple[tuple[Finding, ...], bool]:
    """What was found, and whether there is a relaxation to be reported."""
    findings = _start_findings(evidence)
    if evidence.significance < SIGNIFICANT:
        text = (
            f"No relaxation is seen in {evidence.held_s:.3g} s of load: its share is below "
            f"{evidence.least_share:.2g}."
        )
        advice = (
            "If force drifts nevertheless, hold a larger load for longer and record it from before "
            "it comes."
        )
        findings.append(Finding(Severity.WARNING, text, advice))
        return tuple(findings), False
    if not 0 < evidence.share < BELIEVED_SHARE:
        text = (
            f"The record asks for a share of {evidence.share:.2g}: the force read rises where the "
            "true one does, or falls, the other way than that of a gel that yields."
        )
        advice = (
            "Are reading and reference of the same sign and clock, and not exchanged? Does the "
            "reference drift?"
        )
        return (*findings, Finding(Severity.ERROR, text, advice)), False
    findings += _time_findings(evidence)
    findings += _second_findings(evidence)
    return tuple(findings), True


def _start_findings(evidence: Evidence) -> list[Finding]:
    if evidence.at_start < STARTS_TOUCHED:
        return []
    loaded = evidence.at_start > STARTS_LOADED
    text = f"The record begins with {evidence.at_start:.0%} of the highest reading on the gel"
    text += ": what came before is not known." if loaded else "."
    advice = "Begin while nothing touches the gel and it has recovered from the last contact."
    return [Finding.graded(text, advice, error=loaded)]


def _time_findings(evidence: Evidence) -> list[Finding]:
    useless = (
        evidence.share_std > USELESS_SHARE * evidence.share
        or evidence.time_std > USELESS_TIME * evidence.time
        or evidence.at_longest
    )
    if useless:
        text = (
            f"Loaded for {evidence.held_s:.3g} s the gel does not show how far it yields: a share "
            f"of {evidence.share:.2g} (std {evidence.share_std:.1g}) with {evidence.time:.3g} s "
            f"(std {evidence.time_std:.1g} s)."
        )
        return [Finding(Severity.ERROR, text, _LONGER)]
    findings = []
    if evidence.held_s < HELD_WANTED * evidence.time:
        text = (
            f"The load was held for {evidence.held_s:.3g} s, {evidence.held_s / evidence.time:.2g} "
            "time constants: what fades later is not seen."
        )
        findings.append(Finding(Severity.WARNING, text, _LONGER))
    if evidence.time < SAMPLES_WANTED * evidence.sample_s:
        text = (
            f"Samples come every {evidence.sample_s:.2g} s, too seldom for a time constant of "
            f"{evidence.time:.2g} s."
        )
        advice = "Record at a higher rate."
        findings.append(Finding(Severity.WARNING, text, advice))
    return findings


_LONGER = f"Hold the load for {HELD_WANTED:g} time constants or more."


def _second_findings(evidence: Evidence) -> list[Finding]:
    second = evidence.second
    if second is None or second.significance < SIGNIFICANT or second.differs < SECOND_MATTERS:
        return []
    both = " and ".join(
        f"{share:.2g} with {time:.2g} s"
        for share, time in zip(second.shares, second.times, strict=True)
    )
    text = (
        f"The gel has more than one time constant, about {both}; the one that is fitted misses the "
        f"force of this record by up to {second.differs:.1%} of the highest."
    )
    advice = "Fit a record that is as long as the contacts that matter."
    return [Finding(Severity.WARNING, text, advice)]


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


@kernel
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


@dataclass(frozen=True)
class RelaxationOutcome(WithFindings):
    """What a record shows of a gel's relaxation.

    relaxation: None where there is none to be seen, or the record cannot show it.
    share_std, time_std (s): standard deviations, with the noise as correlated in time as the
    residuals are; correlation: of the two.
    scale, scale_std: true over read force of a quick press, so that `young` times it is the
    instantaneous modulus; NaN where the load is not known.
    residual: RMS of what is left of the force, as a share of the highest.
    held_s: how long the gel was loaded.
    verdict: a sentence or two for people.
    """

    relaxation: GelRelaxation | None
    share_std: float
    time_std: float
    correlation: float
    scale: float
    scale_std: float
    residual: float
    held_s: float
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
    elastic, fit = _fit(record, 0, []), _best(record)
    deviations = _Deviations.from_fit(record, fit)
    # Where there is nothing to be seen the time constant is anything: what would have been seen.
    usual = replace(elastic, terms=np.array([[0.0], [record.held_s / USUAL_HOLD]]))
    least = _Deviations.from_fit(record, usual)
    evidence = Evidence(
        share=fit.share,
        share_std=deviations.share,
        least_share=3 * least.share,
        time=fit.time,
        time_std=deviations.time,
        significance=fit.better_than(elastic),
        at_start=abs(float(record.reading[0])) / record.highest,
        held_s=record.held_s,
        sample_s=record.sample_s,
        at_longest=fit.time >= 0.98 * _time_limits(record)[1],
        second=_second_term(record, fit),
    )
    findings, seen = relaxation_findings(evidence)
    chosen, spread = (fit, deviations) if seen else (elastic, least)
    known = reference is not None
    return RelaxationOutcome(
        relaxation=GelRelaxation(fit.share, fit.time) if seen else None,
        share_std=spread.share,
        time_std=spread.time if seen else math.nan,
        correlation=spread.correlation if seen else math.nan,
        scale=1 / chosen.stiffness if known else math.nan,
        scale_std=spread.stiffness / chosen.stiffness**2 if known else math.nan,
        residual=float(np.sqrt((chosen.residuals**2).mean())) / record.highest,
        held_s=record.held_s,
        findings=findings,
        verdict=_verdict(evidence, seen, findings),
    )


@dataclass(frozen=True)
class _Fit:
    """Parameters of `LoadRecord.predicted`, and read minus predicted where the load is known."""

    stiffness: float
    offset: float
    terms: Array
    residuals: Array
    has_offset: bool

    @property
    def share(self) -> float:
        return float(self.terms[0, 0])

    @property
    def time(self) -> float:
        return float(self.terms[1, 0])

    @property
    def values(self) -> Array:
        """stiffness, shares, logarithms of times, and the offset where there is one."""
        values = [self.stiffness, *self.terms[0], *np.log(self.terms[1])]
        return np.array([*values, self.offset] if self.has_offset else values)

    @property
    def variance(self) -> float:
        """Of a residual, times how many of them say as much as one that is independent."""
        freedom = max(len(self.residuals) - len(self.values), 1)
        together = _correlated_samples(self.residuals)
        return float(self.residuals @ self.residuals) / freedom * together

    def better_than(self, other: _Fit) -> float:
        """By how many variances the squares are less than those of another fit."""
        gained = float(other.residuals @ other.residuals - self.residuals @ self.residuals)
        return gained / self.variance if self.variance > 0 else math.inf


def _residuals(values: Array, record: LoadRecord, count: int) -> Array:
    """Read minus predicted for `_Fit.values` of so many terms."""
    terms = np.stack([values[1 : 1 + count], np.exp(values[1 + count : 1 + 2 * count])])
    offset = float(values[-1]) if record.has_offset else 0.0
    return record.reading[record.known] - record.predicted(float(values[0]), offset, terms)


def _time_limits(record: LoadRecord) -> tuple[float, float]:
    whole = float(record.time[-1] - record.time[0])
    return SHORTEST_STEPS * record.sample_s, LONGEST_RECORDS * whole


def _fit(record: LoadRecord, count: int, starts: list[Array]) -> _Fit:
    """The best fit with so many terms; starts: of these, (2, count) each."""
    known = record.force[record.known]
    stiffness = float(record.reading[record.known] @ known) / float(known @ known)
    low, high = np.log(_time_limits(record))
    offsets = [0.0] if record.has_offset else []
    bounds = [[-np.inf] + [LEAST_SHARE] * count + [low] * count + [-np.inf] * len(offsets)]
    bounds += [[np.inf] + [MOST_SHARE] * count + [high] * count + [np.inf] * len(offsets)]
    scale = [abs(stiffness)] + [0.1] * count + [1.0] * count + [0.1 * record.highest] * len(offsets)
    found = []
    for terms in starts or [np.zeros((2, 0))]:
        times = np.clip(np.log(terms[1]), low + 1e-6, high - 1e-6)
        first = [stiffness, *terms[0], *times, *offsets]
        found.append(
            least_squares(
                _residuals,
                first,
                bounds=bounds,
                x_scale=scale,
                args=(record, count),
                max_nfev=MOST_EVALUATIONS,
            )
        )
    best = min(found, key=lambda item: float(item.cost))
    values = np.asarray(best.x, dtype=np.float64)
    return _Fit(
        stiffness=float(values[0]),
        offset=float(values[-1]) if record.has_offset else 0.0,
        terms=np.stack([values[1 : 1 + count], np.exp(values[1 + count : 1 + 2 * count])]),
        residuals=np.asarray(best.fun, dtype=np.float64),
        has_offset=record.has_offset,
    )


def _best(record: LoadRecord) -> _Fit:
    low, high = _time_limits(record)
    times = np.geomspace(low, high, STARTS + 2)[1:-1]
    return _fit(record, 1, [np.array([[FIRST_SHARE], [time]]) for time in times])


def _split(fit: _Fit, quicker: float, slower: float) -> Array:
    share = float(np.clip(fit.share, 0.02, 0.9)) / 2
    return np.array([[share, share], [quicker * fit.time, slower * fit.time]])


def _second_term(record: LoadRecord, fit: _Fit) -> SecondTerm | None:
    """What a second Prony term adds; None where it is none, or where the rest is but noise."""
    if _correlated_samples(fit.residuals) < HANGS_TOGETHER:
        return None
    second = _fit(record, 2, [_split(fit, *ratios) for ratios in SPLITS])
    if (second.terms[0] <= 0).any():
        return None
    order = np.argsort(second.terms[1])
    shares, times = second.terms[:, order].tolist()
    differs = float(np.abs(second.residuals - fit.residuals).max()) / record.highest
    return SecondTerm(
        shares=(shares[0], shares[1]),
        times=(times[0], times[1]),
        significance=second.better_than(fit),
        differs=differs,
    )


@dataclass(frozen=True)
class _Deviations:
    """Standard deviations of a fit with one term, and the correlation of share and time."""

    share: float
    time: float
    stiffness: float
    correlation: float

    @classmethod
    def from_fit(cls, record: LoadRecord, fit: _Fit) -> _Deviations:
        values = fit.values
        columns = []
        for k in range(len(values)):
            step = np.zeros_like(values)
            step[k] = DERIVATIVE_STEP * max(abs(values[k]), 0.1)
            ends = [_residuals(values + sign * step, record, 1) for sign in (1, -1)]
            columns.append((ends[1] - ends[0]) / (2 * step[k]))
        jacobian = np.stack(columns, axis=1)
        if fit.share == 0:
            # Without a share nothing shows the time constant: it is taken as known.
            jacobian[:, 2] = 0.0
        covariance = fit.variance * np.linalg.pinv(jacobian.T @ jacobian)
        stiffness, share, log = np.sqrt(np.maximum(np.diag(covariance)[:3], 0.0)).tolist()
        size = share * log
        correlation = float(covariance[1, 2]) / size if size > 0 else 0.0
        return cls(share, fit.time * log, stiffness, correlation)


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


def _verdict(evidence: Evidence, seen: bool, findings: tuple[Finding, ...]) -> str:
    refused = bool(errors_in(findings))
    if not seen:
        if refused:
            return "The record does not show how the gel relaxes."
        return f"The gel relaxes by less than {evidence.least_share:.2g} of its modulus."
    text = (
        f"While it is held the gel loses {evidence.share:.1%} "
        f"(std {100 * evidence.share_std:.2g} %) of its modulus with a time constant of "
        f"{evidence.time:.3g} s (std {evidence.time_std:.2g} s)."
    )
    return f"{text} Not to be used: see what was found." if refused else text
