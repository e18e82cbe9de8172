"""Relaxation found from records of closed form; what cannot be determined is reported."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from cmp_tactile_processing.calibration.material.relaxation import fit_relaxation
from cmp_tactile_processing.errors import CalibrationError, Severity

LOAD_N, SCALE, BEGIN_S = 5.0, 1.1, 1.0
RATE_HZ = 15
# Standard deviations that a good fit is off by in few cases of a hundred.
DEVIATIONS = 4.0
RECORDS = 200


def clock(hold_s, seed=0):
    """Unequal times, 1 s at rest and then `hold_s` of load."""
    rng = np.random.default_rng(seed)
    count = round((BEGIN_S + hold_s) * RATE_HZ)
    return np.cumsum(rng.uniform(0.6, 1.4, count)) / RATE_HZ


def weight(time_s, share, tau, noise, seed=0):
    """Reading (n,) N of a gel that creeps under a weight put down at once."""
    rng = np.random.default_rng(seed)
    since = np.maximum(time_s - BEGIN_S, 0)
    grown = 1 + share / (1 - share) * -np.expm1(-(1 - share) * since / tau)
    return LOAD_N / SCALE * grown * (time_s > BEGIN_S) + rng.normal(0, noise, time_s.size)


def pressed(time_s, terms, noise, seed=0):
    """Reading and true force of a gel pressed along a line for 0.5 s and held, terms of E(t)."""
    rng = np.random.default_rng(seed)
    ramp = 0.5
    since = np.maximum(time_s - BEGIN_S, 0)
    loading, held = np.minimum(since, ramp), np.maximum(since - ramp, 0)
    true = loading * (1 - sum(share for share, _ in terms))
    for share, tau in terms:
        true = true + share * tau * -np.expm1(-loading / tau) * np.exp(-held / tau)
    reading = LOAD_N / SCALE * loading / ramp
    noises = rng.normal(0, noise, (2, time_s.size))
    return reading + noises[0], LOAD_N / ramp * true + noises[1]


def texts(outcome, severity):
    return " ".join(item.text for item in outcome.findings if item.severity is severity)


@pytest.mark.parametrize(
    ("share", "tau", "hold_s", "noise"),
    [
        (0.2, 2.0, 15, 0.03),
        (0.05, 4.0, 30, 0.01),
        (0.3, 10.0, 40, 0.03),
        # Most of the reading is creep.
        (0.7, 2.0, 60, 0.03),
        (0.8, 10.0, 300, 0.03),
    ],
)
def test_a_weight_determines_share_and_time(share, tau, hold_s, noise):
    time_s = clock(hold_s)
    reading = weight(time_s, share, tau, noise)
    # How it was put down is nobody's to know.
    reading[(time_s > BEGIN_S) & (time_s < BEGIN_S + 0.06)] *= 0.5
    for sign, reference in ((-1, -LOAD_N), (1, None)):
        found = fit_relaxation(time_s, sign * reading, reference)
        assert found.accepted, found.findings
        assert abs(found.relaxation.share - share) < DEVIATIONS * found.share_std < share
        assert abs(found.relaxation.time - tau) < DEVIATIONS * found.time_std < tau
        if reference is None:
            assert np.isnan(found.scale)
        else:
            assert abs(found.scale - SCALE) < DEVIATIONS * found.scale_std < 0.1
        assert f"{found.relaxation.share:.1%}" in found.verdict


def test_a_weight_that_is_taken_away_leaves_creep_that_is_no_load():
    """A gel of a large share shows more than half of its highest reading without a load."""
    time_s, share, tau, end_s = clock(60), 0.7, 2.0, 40.0
    reading = weight(time_s, share, tau, 0.02)
    late = time_s > end_s
    reading[late] -= weight(time_s - end_s + BEGIN_S, share, tau, 0.0)[late]
    found = fit_relaxation(time_s, reading, LOAD_N)
    assert found.accepted, found.findings
    assert abs(found.relaxation.share - share) < DEVIATIONS * found.share_std < 0.1
    assert abs(found.relaxation.time - tau) < DEVIATIONS * found.time_std < 0.5


def test_a_gel_that_shows_creep_alone_is_refused():
    time_s = clock(100)
    found = fit_relaxation(time_s, weight(time_s, 0.95, 2.0, 0.03), LOAD_N)
    assert not found.accepted
    assert "Within 0.3 s the reading rises" in texts(found, Severity.ERROR)


def test_a_force_sensor_with_an_offset_determines_share_and_time():
    time_s = clock(20)
    reading, true = pressed(time_s, [(0.15, 3.0)], 0.02)
    true[100:110] = np.nan
    reading[200:205] = np.nan
    found = fit_relaxation(time_s, reading, true + 0.3)
    assert found.accepted, found.findings
    assert abs(found.relaxation.share - 0.15) < DEVIATIONS * found.share_std < 0.03
    assert abs(found.relaxation.time - 3.0) < DEVIATIONS * found.time_std < 1.0
    assert abs(found.scale - SCALE) < DEVIATIONS * found.scale_std
    assert found.residual < 0.02


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_the_standard_deviations_are_those_of_many_records(memory):
    """White noise, or noise of which so much is left in the next sample; no bias by it."""
    off = []
    for seed in range(RECORDS):
        time_s = clock(12, seed)
        white = np.random.default_rng(seed).normal(0, 0.05, len(time_s))
        noise = lfilter([np.sqrt(1 - memory**2)], [1, -memory], white)
        found = fit_relaxation(time_s, weight(time_s, 0.2, 0.5, 0.0) + noise, LOAD_N)
        share, tau = found.relaxation.share, found.relaxation.time
        off.append([(share - 0.2) / found.share_std, (tau - 0.5) / found.time_std])
    # The root of chi-squared of 200 over 200 is within these for 99.8 %.
    size = np.sqrt(np.mean(np.square(off), axis=0))
    assert (size > 0.84).all()
    assert (size < 1.16).all()
    assert (np.abs(np.mean(off, axis=0)) < 3.3 / RECORDS**0.5).all()


def test_an_elastic_gel_has_no_relaxation():
    time_s = clock(20)
    found = fit_relaxation(time_s, weight(time_s, 0.0, 1.0, 0.03), LOAD_N)
    assert found.relaxation is None
    assert found.accepted
    assert "No relaxation was found" in texts(found, Severity.WARNING)
    assert "less than 0.00" in found.verdict
    assert found.scale == pytest.approx(SCALE, rel=0.01)


def test_a_hold_that_is_too_short_is_reported():
    time_s = clock(6)
    found = fit_relaxation(time_s, weight(time_s, 0.3, 4.0, 0.005), LOAD_N)
    assert "slower relaxation is not found" in texts(found, Severity.WARNING)
    time_s = clock(3)
    found = fit_relaxation(time_s, weight(time_s, 0.2, 20.0, 0.02), LOAD_N)
    assert not found.accepted
    assert "too short to determine the relaxation" in texts(found, Severity.ERROR)


def test_a_second_time_constant_is_reported_and_one_alone_is_not():
    time_s = clock(30)
    found = fit_relaxation(time_s, *pressed(time_s, [(0.1, 0.5), (0.15, 8.0)], 0.01))
    assert found.accepted
    assert "One time constant does not describe" in texts(found, Severity.WARNING)
    for seed in range(3):
        one = fit_relaxation(time_s, *pressed(time_s, [(0.2, 2.0)], 0.01, seed))
        assert one.findings == ()


def test_a_record_that_begins_with_a_load_is_refused():
    time_s = clock(20)
    late = time_s > BEGIN_S + 0.5
    found = fit_relaxation(time_s[late], weight(time_s, 0.2, 2.0, 0.02)[late], LOAD_N)
    assert not found.accepted
    assert "begins with" in texts(found, Severity.ERROR)


def test_exchanged_records_are_refused():
    time_s = clock(20)
    reading, true = pressed(time_s, [(0.3, 2.0)], 0.01)
    found = fit_relaxation(time_s, true, reading)
    assert found.relaxation is None
    assert not found.accepted
    assert "the opposite direction" in texts(found, Severity.ERROR)


def test_a_weight_on_a_gel_of_two_time_constants_gives_one_between():
    """And not one as short as the samples' distance, from which noise could be distinguished."""
    time_s, two = clock(20), ((0.1, 0.5), (0.1, 10.0))
    # Small steps of force: the creep of a gel of two terms by the trapezoidal rule.
    fine = np.arange(0, time_s[-1] + 0.01, 0.01)
    kernel = -0.01 * sum(share / tau * np.exp(-fine / tau) for share, tau in two)
    shown = np.zeros_like(fine)
    for k in np.flatnonzero(fine > BEGIN_S):
        past = kernel[k:0:-1] @ shown[:k]
        shown[k] = (LOAD_N - past) / (1 + kernel[0] / 2)
    reading = np.interp(time_s, fine, shown) + np.random.default_rng(0).normal(0, 0.02, time_s.size)
    found = fit_relaxation(time_s, reading, LOAD_N)
    assert found.accepted, found.findings
    assert 0.1 < found.relaxation.share < 0.22
    assert 0.5 < found.relaxation.time < 10
    assert "One time constant does not describe" in texts(found, Severity.WARNING)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda t, g: (t[:-1], g, 5.0), r"reading: found shape \(45,\) at times \(44,\)"),
        (lambda t, g: (t, g, g[:3]), r"reference: found shape \(3,\), expected \(45,\)"),
        (lambda t, g: (t[:20], g[:20], 5.0), r"reading: found 20 samples, expected at least 30"),
        (lambda t, g: (t[::-1], g, 5.0), r"time_s: found .* s after a later time"),
        (lambda t, g: (t, 0 * g, 5.0), r"reading: found 0 throughout"),
        (lambda t, g: (t, g, 0.0), r"found .*expected at least 30"),
    ],
)
def test_records_of_another_form_are_named(change, expected):
    time_s = clock(2)
    with pytest.raises(CalibrationError, match=expected):
        fit_relaxation(*change(time_s, weight(time_s, 0.2, 0.5, 0.01)))
