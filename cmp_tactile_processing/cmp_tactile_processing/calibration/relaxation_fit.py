"""Relaxation of a gel from the record of a load: how much of its modulus fades, and how fast.

The record begins with the gel untouched and recovered; then it is loaded, at best within a
moment, and held.  An elastic inverse reads a force g from its displacement, which differs from
the force F on the gel by what the gel gives up:

    F(t) = scale (g(t) - share q(t)) + offset,    dq/dt = (g - q) / time.

Either F is known at each time, as from a force sensor, while g or F changes, or F is a weight and
g creeps.  For each time constant the rest is linear, so that is looked for along a line alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.outcome import Finding, Severity
from cmp_tactile_processing.calibration.relaxation_findings import (
    Evidence,
    SecondTerm,
    relaxation_findings,
)
from cmp_tactile_processing.calibration.relaxation_record import LoadRecord
from cmp_tactile_processing.relaxation import step_weights
from cmp_tactile_processing.sensor_description import GelRelaxation

__all__ = ["RelaxationOutcome", "fit_relaxation"]

Array = NDArray[np.float64]

GRID, ZOOM, ZOOMS = 48, 15, 5
# Of a relaxation that is not seen: the length of the hold over the time constant to tell of.
USUAL_HOLD = 5.0
# Pairs of time constants are looked for on every so-manyth of the grid.
PAIR_STRIDE = 2
# Relative step of the derivative by the time constant.
DERIVATIVE_STEP = 1e-3


@dataclass(frozen=True)
class RelaxationOutcome:
    """What a record tells of a gel's relaxation.

    relaxation: None where there is none to be seen, or the record cannot tell.
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

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against using it."""
        return not any(item.severity is Severity.ERROR for item in self.findings)


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
    record = LoadRecord.of(time_s, reading, reference)
    fit = _best(record)
    second = _second_term(record, fit)
    # Where there is nothing to be seen the time constant is anything: what would have been seen.
    usual = _with_deviations(record, record.held_s / USUAL_HOLD)
    evidence = Evidence(
        share=fit.share,
        share_std=fit.share_std,
        least_share=3 * usual.share_std,
        time=fit.time,
        time_std=fit.time_std,
        significance=fit.significance,
        at_start=abs(float(record.reading[0])) / record.highest,
        held_s=record.held_s,
        sample_s=record.sample_s,
        at_longest=fit.time >= 0.98 * record.longest,
        second=second,
    )
    findings, seen = relaxation_findings(evidence)
    relaxation = GelRelaxation(fit.share, fit.time) if seen else None
    known = reference is not None
    return RelaxationOutcome(
        relaxation=relaxation,
        share_std=fit.share_std if seen else usual.share_std,
        time_std=fit.time_std if seen else math.nan,
        correlation=fit.correlation if seen else math.nan,
        scale=fit.scale if known else math.nan,
        scale_std=fit.scale_std if known else math.nan,
        residual=fit.rms / float(np.abs(record.force).max()),
        held_s=record.held_s,
        findings=findings,
        verdict=_verdict(fit, evidence, seen, findings),
    )


@dataclass(frozen=True)
class _Fit:
    share: float
    time: float
    scale: float
    share_std: float
    time_std: float
    scale_std: float
    correlation: float
    significance: float
    rms: float
    squares: float
    predicted: Array


def _best(record: LoadRecord) -> _Fit:
    times = record.times(GRID)
    for _ in range(ZOOMS):
        lags = record.lags(times)
        squares = [_squares(record, lag, time) for lag, time in zip(lags, times, strict=True)]
        at = int(np.argmin(squares))
        low, high = times[max(at - 1, 0)], times[min(at + 1, len(times) - 1)]
        best, times = float(times[at]), np.geomspace(low, high, ZOOM)
    return _with_deviations(record, best)


def _squares(record: LoadRecord, lag: Array, time: float) -> float:
    """Squares left with one time constant, over the noise that each sample brings new.

    Where the time constant is as short as samples are distant, the lag takes a part of that noise
    away and leaves that of earlier samples: a fit to noise that is not to look better for it.
    """
    line = _line(record, _columns(record, lag))
    share = float(line.values[0]) / line.scale if line.scale != 0 else 0.0
    now = float(step_weights(np.array(record.sample_s / time))[2])
    noise = line.scale * record.read_noise * (1 - share * now)
    return float(line.residuals @ line.residuals) / (record.force_noise**2 + noise**2)


def _with_deviations(record: LoadRecord, time: float) -> _Fit:
    lags = record.lags(time * np.exp(np.array([-1.0, 0.0, 1.0]) * DERIVATIVE_STEP))
    columns = _columns(record, lags[1])
    line = _line(record, columns)
    scale, lost = line.scale, float(line.values[0])
    slope = -lost * (lags[2] - lags[0]) / (2 * DERIVATIVE_STEP)
    jacobian = np.column_stack([line.read, columns, slope])
    freedom = max(len(slope) - jacobian.shape[1], 1)
    # Residuals that hang together tell less than so many that do not.
    together = _correlated_samples(line.residuals)
    variance = float(line.residuals @ line.residuals) / freedom * together
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
    # share = lost / scale, log(time) and scale, of (scale, lost, ..., log(time)).
    change = np.zeros((3, jacobian.shape[1]))
    change[0, :2] = -lost / scale**2, 1 / scale
    change[1, -1], change[2, 0] = 1.0, 1.0
    spread = change @ covariance @ change.T
    share_std, log_std, scale_std = np.sqrt(np.maximum(np.diag(spread), 0))
    size = share_std * log_std
    gained = _line(record, columns[:, 1:]).squares - line.squares
    return _Fit(
        share=lost / scale,
        time=time,
        scale=scale,
        share_std=float(share_std),
        time_std=time * float(log_std),
        scale_std=float(scale_std),
        correlation=float(spread[0, 1] / size) if size > 0 else 0.0,
        significance=_in_variances(gained, line.squares / freedom * together),
        rms=float(np.sqrt((line.residuals**2).mean())),
        squares=line.squares,
        predicted=columns @ line.values + scale * line.read,
    )


def _second_term(record: LoadRecord, fit: _Fit) -> SecondTerm | None:
    """What a second Prony term adds; None where the fit gets no better by it."""
    times = record.times(GRID)[::PAIR_STRIDE]
    lags = record.lags(times)
    least: _Line | None = None
    pair = 0, 0
    for i in range(len(times)):
        for j in range(i + 1, len(times)):
            line = _line(record, np.column_stack([-lags[i], _columns(record, lags[j])]))
            better = least is None or line.squares < least.squares
            if better and (line.values[:2] / line.scale > 0).all():
                least, pair = line, (i, j)
    if least is None:
        return None
    freedom = max(len(least.residuals) - len(least.values) - 3, 1)
    variance = least.squares / freedom * _correlated_samples(least.residuals)
    columns = np.column_stack([-lags[pair[0]], _columns(record, lags[pair[1]])])
    predicted = columns @ least.values + least.scale * least.read
    differs = np.abs(predicted - fit.predicted).max() / np.abs(record.force).max()
    shares = least.values[:2] / least.scale
    return SecondTerm(
        shares=(float(shares[0]), float(shares[1])),
        times=(float(times[pair[0]]), float(times[pair[1]])),
        significance=_in_variances(fit.squares - least.squares, variance),
        differs=float(differs),
    )


def _in_variances(gained: float, variance: float) -> float:
    return gained / variance if variance > 0 else math.inf


def _columns(record: LoadRecord, lag: Array) -> Array:
    """What the force consists of beside the reading: lag and offset, (known, 1 or 2)."""
    return np.column_stack([-lag, np.ones(len(lag))]) if record.has_offset else -lag[:, None]


@dataclass(frozen=True)
class _Line:
    """force = scale * reading + columns @ values + residuals.

    read: the reading without its noise, as the line and the force have it.
    squares: of the residuals over the standard deviation of force and reading together.
    """

    scale: float
    values: Array
    residuals: Array
    read: Array
    squares: float


def _line(record: LoadRecord, columns: Array) -> _Line:
    """The line through force and reading, both with noise, and columns without (Deming)."""
    base = np.linalg.qr(columns)[0]
    pair = np.stack([record.force, record.read])
    off = pair - (pair @ base) @ base.T
    scaled = off / np.array([[record.force_noise], [record.read_noise]])
    a, b, c = (float(scaled[i] @ scaled[j]) for i, j in ((0, 0), (0, 1), (1, 1)))
    # Least of |y - m x|^2 / (1 + m^2), y and x with noise of 1.
    m = (a - c + math.hypot(a - c, 2 * b)) / (2 * b) if b != 0 else 0.0
    scale = m * record.force_noise / record.read_noise
    rest = record.force - scale * record.read
    values = np.asarray(np.linalg.lstsq(columns, rest, rcond=None)[0], dtype=np.float64)
    residuals = rest - columns @ values
    variance = record.force_noise**2 + (scale * record.read_noise) ** 2
    read = record.read + residuals * scale * record.read_noise**2 / variance
    return _Line(scale, values, residuals, read, float(residuals @ residuals) / variance)


def _correlated_samples(residuals: Array) -> float:
    """How many samples tell as much as one that is independent: the autocorrelation's integral.

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


def _verdict(fit: _Fit, evidence: Evidence, seen: bool, findings: tuple[Finding, ...]) -> str:
    refused = any(item.severity is Severity.ERROR for item in findings)
    if not seen:
        if refused:
            return "The record does not tell how the gel relaxes."
        return f"The gel relaxes by less than {evidence.least_share:.2g} of its modulus."
    text = (
        f"While it is held the gel loses {fit.share:.1%} (std {fit.share_std:.1%}) of its modulus "
        f"with a time constant of {fit.time:.3g} s (std {fit.time_std:.2g} s)."
    )
    return f"{text} Not to be used: see what was found." if refused else text
