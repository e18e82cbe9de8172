"""The relaxation filter against closed forms of a viscoelastic gel, and through bad frames."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from cmp_tactile_processing.elastic.relaxation import RelaxationFilter, step_weights
from cmp_tactile_processing.sensor.parts import GelRelaxation

GEL = GelRelaxation(share=0.3, time=2.0)
MARKERS = (4, 5)
SEEN = np.ones(MARKERS, np.uint8)
# Displacement of each component for unit force, m/N; no two alike.
RESPONSE = np.random.default_rng(5).normal(0, 1e-4, (*MARKERS, 3))
# Of an integral over the whole load.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)
# Rounding of displacements of 0.1 mm.
ATOL_M = 1e-15


def creep(time_s):
    """Displacement of the gel `time_s` after a unit step of force, over the elastic one.

    The inverse of E(t) / young = 1 - share + share exp(-t / time) under convolution.
    """
    slow = GEL.time / (1 - GEL.share)
    grown = 1 + GEL.share / (1 - GEL.share) * -np.expm1(-np.asarray(time_s) / slow)
    return np.where(np.asarray(time_s) >= 0, grown, 0.0)


def crept(rate, end, time_s):
    """Displacement over RESPONSE under a force of this rate until `end`, by superposition."""
    found = []
    for t in time_s:
        until = min(t, end)
        at, weights = until * (NODES + 1) / 2, until * WEIGHTS / 2
        found.append((weights * rate(at) * creep(t - at)).sum())
    return np.array(found)


def run(filtered, time_s, shown, status=None):
    """The filter's force for displacements RESPONSE * shown at times in s."""
    states = SEEN if status is None else status
    return [
        filtered.effective(RESPONSE * u, states, round(1e9 * t))
        for t, u in zip(time_s, shown, strict=True)
    ]


def test_the_force_of_a_gel_that_creeps_is_found():
    """A load that grows and is held, at unequal frames, from the creep's closed form."""
    end = np.pi / 2
    worst = []
    for rate_hz in (30, 60):
        rng = np.random.default_rng(1)
        time_s = np.cumsum(np.r_[0.0, rng.uniform(0.5, 1.5, 6 * rate_hz) / rate_hz])
        shown = crept(lambda t: np.sin(2 * t), end, time_s)
        assert shown[-1] > 1.3
        found = run(RelaxationFilter(GEL), time_s, shown)
        force = np.sin(np.minimum(time_s, end)) ** 2
        error = np.abs(found - force[:, None, None, None] * RESPONSE).max()
        worst.append(error / np.abs(RESPONSE).max())
    assert worst[0] < 1e-4
    # What is curved between frames: second order in their distance.
    assert np.log2(worst[0] / worst[1]) == pytest.approx(2, abs=0.3)


def test_steps_of_any_length_add_up():
    """One step and its pieces are the same, from none to a thousand time constants."""
    for length in (0.0, 1e-12, 1e-3, 1.0, 50.0, 1e3):
        whole = RelaxationFilter(GEL)
        parts = RelaxationFilter(GEL)
        in_one = run(whole, [0.0, length], [0.5, 2.0])[-1]
        pieces = np.linspace(0, 1, 7) ** 2
        in_parts = run(parts, length * pieces, 0.5 + 1.5 * pieces)[-1]
        np.testing.assert_allclose(in_one, in_parts, rtol=0, atol=1e-12 if length < 1e-6 else 1e-13)
        assert sum(float(w) for w in step_weights(np.array(length))) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize("how", ["status", "nan", "depth"])
def test_a_marker_that_was_hidden_goes_on_as_if_it_had_moved_straight(how):
    """In the frames without it the others are found, and it is NaN, not 0."""
    time_s = np.arange(0, 6, 0.1)
    shown = np.interp(time_s, [0, 1, 2, 4, 6], [0, 0, 3, 1, 1])
    expected = run(RelaxationFilter(GEL), time_s, shown)
    filtered = RelaxationFilter(GEL)
    for t, u, full in zip(time_s, shown, expected, strict=True):
        moved, status = RESPONSE * u, SEEN.copy()
        hidden = 2.05 < t < 3.55
        if hidden:
            part = np.s_[1, 2, 2] if how == "depth" else np.s_[1, 2]
            moved[part] = np.nan
            status[1, 2] = how == "depth"
        found = filtered.effective(moved, status, round(1e9 * t))
        missing = np.isnan(moved)
        assert np.isnan(found[missing]).all()
        np.testing.assert_allclose(found[~missing], full[~missing], rtol=0, atol=ATOL_M)


def test_the_same_stamp_replaces_the_frame_and_an_earlier_one_begins_again(caplog):
    filtered = RelaxationFilter(GEL)
    run(filtered, [0.0, 1.0], [0.0, 1.0])
    once, again = run(filtered, [2.0, 2.0], [3.0, 3.0])
    np.testing.assert_array_equal(once, again)
    with caplog.at_level(logging.INFO):
        found = run(filtered, [0.5, 1.0], [1.0, 1.0])
    np.testing.assert_allclose(found, (1 - GEL.share) * RESPONSE[None].repeat(2, 0), atol=ATOL_M)
    (message,) = caplog.messages
    assert "time went back by 1.500 s" in message


def test_without_a_stamp_the_displacement_is_left_as_it_is_and_that_is_reported_once(caplog):
    filtered, other = RelaxationFilter(GEL), RelaxationFilter(GEL)
    run(filtered, [0.0, 1.0], [0.0, 1.0])
    run(other, [0.0, 1.0], [0.0, 1.0])
    for _ in range(2):
        np.testing.assert_array_equal(filtered.effective(7 * RESPONSE, SEEN, None), 7 * RESPONSE)
    assert len(caplog.messages) == 1
    assert "frames without a stamp" in caplog.messages[0]
    np.testing.assert_array_equal(run(filtered, [2.0], [1.0]), run(other, [2.0], [1.0]))
