"""Relaxation of a gel from the record of a load: how much of its modulus fades, and how fast.

The record begins with the gel untouched and recovered; then it is loaded, at best within a
moment, and held.  An elastic inverse reads a force g from its displacement, which differs from
the force F on the gel by what the gel gives up:

    F = scale (g - share q),    dq/dt = (g - q) / time.

Solved for g, that is a step and a creep of the force, linear but for one time constant:

    g = stiffness F + creep p,    dp/dt = (F - p) / lag,

with stiffness = 1 / scale, share = creep / (stiffness + creep), time = lag (1 - share).  F is what
a force sensor reads, or a weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from cmp_tactile_processing.calibration.outcome import WithFindings, finding
from cmp_tactile_processing.elastic.relaxation import step_weights
from cmp_tactile_processing.errors import CalibrationError, Finding, errors_in
from cmp_tactile_processing.sensor.parts import GelRelaxation

Array = NDArray[np.float64]

FEWEST_SAMPLES = 30
# Beside a force sensor, the gel is loaded where its reading is above this share of the highest.
LOADED_SHARE = 0.5
# A weight comes and goes within this time.
SETTLE_S = 0.3
# In it the reading changes by this share of the highest at least: a gel that loses more of its
# modulus, or a weight that comes slowly, shows creep alone.
MIN_STEP_SHARE = 0.12
# How much better creep must make the fit, in variances, to be believed: its time constant was
# looked for, so that noise alone gets to 15 in one record of 1,000.
SIGNIFICANT = 20.0
# A reading at the beginning above this share of the highest is a gel that was loaded before.
STARTS_LOADED = 0.1
# Lags are looked for from the samples' distance to so many lengths of the record, first on a grid;
# beyond AT_LONGEST of the longest it is not known.
LONGEST_RECORDS, GRID, AT_LONGEST = 5.0, 20, 0.98
# Lag over which its derivative is taken, logarithm.
STEP = 1e-4
# Time constants for which a load should be held; the usual one, and standard deviations of its
# share that would be seen, where no relaxation is.
HELD_WANTED, USUAL_HOLD, SEEN = 3.0, 5.0, 3.0
# Relative standard deviations above which a value is of no use.
USELESS_SHARE, USELESS_TIME = 0.3, 0.5
# Residuals that are correlated over more samples than those of noise, and larger than this share of
# the highest reading, are not those of one time constant.
HANGS_TOGETHER, MISFIT_SHARE = 3.0, 0.001


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
    reference: the true force (n,) N in the same direction, NaN where it is not known, with any
    offset; or the weight that rests on the gel, N, one number; None for a weight that is not known.
    Raises CalibrationError for records that are not of this form.
    """
    record = _Record.from_readings(time_s, reading, reference)
    elastic, fit = record.fit(None), record.best()
    usual = record.fit(record.held_s / USUAL_HOLD)
    least_share = SEEN * usual.share_std
    creeps = elastic.squares - fit.squares >= SIGNIFICANT * fit.variance
    seen = creeps and fit.share > 0
    findings = _start_findings(record)
    if not creeps:
        values = {"held": record.held_s, "least": least_share}
        findings.append(finding("no relaxation", error=False, **values))
    elif not seen:
        findings.append(finding("opposite", error=True, share=fit.share))
    else:
        findings += _time_findings(record, fit) + _misfit_findings(record, fit)
    chosen = fit if seen else elastic
    known = reference is not None
    found = RelaxationOutcome(
        relaxation=GelRelaxation(fit.share, fit.time) if seen else None,
        share_std=fit.share_std if seen else usual.share_std,
        time_std=fit.time_std if seen else math.nan,
        scale=1 / chosen.stiffness if known else math.nan,
        scale_std=chosen.stiffness_std / chosen.stiffness**2 if known else math.nan,
        residual=chosen.rms / record.highest,
        findings=tuple(findings),
        verdict="",
    )
    return replace(found, verdict=_verdict(found, least_share))


@dataclass(frozen=True)
class _Record:
    """A checked record of a load on a gel.

    force (n,): the reference; known (n,): where it is to be compared.  has_offset: whether the
    reference may have one.  highest: reading, N.  held_s: how long the gel was loaded.
    step: change of the reading as a weight comes, N; onset_std: of the time at which it came, s;
    NaN and 0 beside a force sensor.
    """

    time: Array
    reading: Array
    force: Array
    known: NDArray[np.bool_]
    has_offset: bool
    highest: float
    held_s: float
    step: float = math.nan
    onset_std: float = 0.0

    @classmethod
    def from_readings(
        cls, time_s: Array, reading: Array, reference: Array | float | None
    ) -> _Record:
        """The record of what `fit_relaxation` takes, with its errors."""
        time, shown, force = _checked(time_s, reading, reference)
        highest = float(np.abs(shown).max())
        from_sensor = reference is not None and np.ndim(reference) > 0
        step, onset_std = math.nan, 0.0
        if from_sensor:
            loaded = np.abs(shown) > LOADED_SHARE * highest
            known = np.isfinite(force)
        else:
            step = _largest_step(time, np.abs(shown))
            loaded = _under_weight(np.abs(shown), step / 2)
            onset_std = _onset_std(time, np.abs(shown), int(np.argmax(loaded)), step)
            force = np.where(loaded, 1.0 if reference is None else float(reference or 0.0), 0.0)
            known = loaded & ~_beside(time, ~loaded)
        if known.sum() < FEWEST_SAMPLES or not force[known].any():
            msg = (
                f"samples under a known load: found {int(known.sum())}, expected at least "
                f"{FEWEST_SAMPLES}, and a load that is not always 0"
            )
            raise CalibrationError(msg)
        given = np.isfinite(force)
        force = np.interp(time, time[given], force[given])
        held_s = float(np.diff(time)[loaded[1:]].sum())
        return cls(time, shown, force, known, from_sensor, highest, held_s, step, onset_std)

    @property
    def longest(self) -> float:
        """The longest lag that is looked for, s."""
        return LONGEST_RECORDS * float(self.time[-1] - self.time[0])

    def best(self) -> _Fit:
        """The best fit with creep."""
        shortest = float(np.median(np.diff(self.time)))
        grid = np.linspace(math.log(shortest), math.log(self.longest), GRID)
        start = int(np.argmin([self.fit(math.exp(log)).squares for log in grid]))
        bounds = grid[max(start - 1, 0)], grid[min(start + 1, GRID - 1)]
        found = minimize_scalar(
            lambda log: self.fit(math.exp(log)).squares, bounds=bounds, method="bounded"
        )
        return self.fit(math.exp(found.x))

    def fit(self, lag: float | None) -> _Fit:
        """The best fit with that lag, s; None: without creep."""
        columns = [self.force]
        if lag is not None:
            columns.append(self._remembered(lag))
        if self.has_offset:
            columns.append(np.ones_like(self.force))
        A, read = np.stack(columns, axis=1)[self.known], self.reading[self.known]
        x = np.linalg.lstsq(A, read, rcond=None)[0]
        if lag is None:
            return _Fit(float(x[0]), 0.0, math.nan, A, read - A @ x, self.onset_std)
        slope = (self._remembered(lag * math.exp(STEP)) - columns[1])[self.known] / STEP
        jacobian = np.column_stack([A[:, :2], x[1] * slope, A[:, 2:]])
        return _Fit(float(x[0]), float(x[1]), lag, jacobian, read - A @ x, self.onset_std)

    def _remembered(self, lag: float) -> Array:
        """The force (n,) as a gel with that lag remembers it; at first it was always as then."""
        kept, of_before, of_now = step_weights(np.diff(self.time) / lag)
        added = of_before * self.force[:-1] + of_now * self.force[1:]
        past = np.full(len(self.time), self.force[0])
        for k in range(1, len(past)):
            past[k] = kept[k - 1] * past[k - 1] + added[k - 1]
        return past


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


def _largest_step(time: Array, reading: Array) -> float:
    """Largest rise of a reading (n,) N within the time that a weight takes to settle."""
    last = np.searchsorted(time, time + SETTLE_S, side="right") - 1
    return float(np.max(reading[last] - reading))


def _onset_std(time: Array, reading: Array, came: int, step: float) -> float:
    """Of the time at which a weight came, s: between samples before and after most of its step."""
    risen = reading - reading[:came].min(initial=reading[came])
    before = np.flatnonzero(risen[: came + 1] < step / 4)
    after = np.flatnonzero(risen[came:] > 3 * step / 4)
    if not len(before) or not len(after):
        return SETTLE_S
    return float(time[came + after[0]] - time[before[-1]]) / math.sqrt(12)


def _under_weight(reading: Array, step: float) -> NDArray[np.bool_]:
    """Samples (n,) after a rise by a step above the lowest since the last fall by as much."""
    loaded = np.zeros(len(reading), dtype=np.bool_)
    turned, under = reading[0], False
    for k, value in enumerate(reading):
        turned = max(turned, value) if under else min(turned, value)
        if abs(value - turned) > step:
            under, turned = not under, value
        loaded[k] = under
    return loaded


def _beside(time: Array, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which samples (n,) are nearer in time to one without load than a weight takes to settle."""
    before = np.maximum.accumulate(np.where(free, time, -np.inf))
    after = np.minimum.accumulate(np.where(free, time, np.inf)[::-1])[::-1]
    return np.asarray((time - before < SETTLE_S) | (after - time < SETTLE_S))


@dataclass(frozen=True)
class _Fit:
    """Parameters of the prediction, its derivatives (m, n) by stiffness, creep, log of the lag and
    offset (by stiffness and offset alone without creep), and read minus predicted (m,) N.
    onset_std: of the time of the load, s: a later one looks like less creep and more stiffness.
    """

    stiffness: float
    creep: float
    lag: float
    jacobian: Array
    residuals: Array
    onset_std: float

    @property
    def _onset_share(self) -> float:
        """Standard deviation of the creep before the onset, relative."""
        return self.onset_std / self.lag if self.creep else 0.0

    @property
    def share(self) -> float:
        """Of the modulus, that fades."""
        return self.creep / (self.stiffness + self.creep)

    @property
    def time(self) -> float:
        """Time constant, s."""
        return self.lag * (1 - self.share)

    @property
    def squares(self) -> float:
        """Sum of the squared residuals, N^2."""
        return float(self.residuals @ self.residuals)

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, N."""
        return math.sqrt(self.squares / len(self.residuals))

    @property
    def variance(self) -> float:
        """Of a residual, times how many of them say as much as one that is independent."""
        return self.rms**2 * _correlated_samples(self.residuals)

    @property
    def stiffness_std(self) -> float:
        """Standard deviation of the stiffness."""
        return math.hypot(self._std([1.0]), self.creep * self._onset_share)

    @property
    def share_std(self) -> float:
        """Standard deviation of the share."""
        whole = self.stiffness + self.creep
        by_noise = self._std([-self.creep / whole**2, self.stiffness / whole**2])
        return math.hypot(by_noise, self.share * self._onset_share)

    @property
    def time_std(self) -> float:
        """Standard deviation of the time constant, s."""
        whole = self.stiffness + self.creep
        by_noise = self.time * self._std([1 / self.stiffness - 1 / whole, -1 / whole, 1.0])
        return math.hypot(by_noise, self.share * self.onset_std)

    def _std(self, slope: list[float]) -> float:
        """Standard deviation of a value with these derivatives by the first parameters."""
        covariance = self.variance * np.linalg.pinv(self.jacobian.T @ self.jacobian)
        part = covariance[: len(slope), : len(slope)]
        return math.sqrt(max(float(slope @ part @ slope), 0.0))


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


def _start_findings(record: _Record) -> list[Finding]:
    """Is the gel untouched at first, and does the load come at once?"""
    findings = []
    at_start = abs(float(record.reading[0])) / record.highest
    if at_start >= STARTS_LOADED:
        findings.append(finding("loaded start", error=True, share=at_start))
    if record.step < MIN_STEP_SHARE * record.highest:
        share = record.step / record.highest
        values = {"settle": SETTLE_S, "share": share, "limit": MIN_STEP_SHARE}
        findings.append(finding("slow load", error=True, **values))
    return findings


def _time_findings(record: _Record, fit: _Fit) -> list[Finding]:
    """Is the record long enough for its time constant?"""
    held_s = record.held_s
    if (
        fit.share_std > USELESS_SHARE * fit.share
        or fit.time_std > USELESS_TIME * fit.time
        or fit.lag >= AT_LONGEST * record.longest
    ):
        values = {"held": held_s, "fit": fit, "wanted": HELD_WANTED}
        return [finding("too short", error=True, **values)]
    if held_s >= HELD_WANTED * fit.time:
        return []
    values = {"held": held_s, "constants": held_s / fit.time, "wanted": HELD_WANTED}
    return [finding("short", error=False, **values)]


def _misfit_findings(record: _Record, fit: _Fit) -> list[Finding]:
    """Does one time constant describe the record?"""
    share = fit.rms / record.highest
    if _correlated_samples(fit.residuals) < HANGS_TOGETHER or share < MISFIT_SHARE:
        return []
    return [finding("several constants", error=False, share=share)]


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
