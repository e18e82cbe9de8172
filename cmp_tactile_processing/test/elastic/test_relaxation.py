"""The relaxation filter through bad frames.

That it finds the force of a gel of closed form: gel/test_relaxation.py of the simulation.
"""

from __future__ import annotations

import logging

import numpy as np
import pytest

from cmp_tactile_processing.elastic.relaxation import RelaxationFilter
from cmp_tactile_processing.sensor.parts import GelRelaxation

GEL = GelRelaxation(share=0.3, time=2.0)
MARKERS = (4, 5)
SEEN = np.ones(MARKERS, np.uint8)
# Displacement of each component for unit force, m/N; no two alike.
RESPONSE = np.random.default_rng(5).normal(0, 1e-4, (*MARKERS, 3))
# Rounding of displacements of 0.1 mm.
ATOL_M = 1e-15


def run(filtered, time_s, shown, status=None):
    """The filter's force for displacements RESPONSE * shown at times in s."""
    states = SEEN if status is None else status
    return [
        filtered.effective(RESPONSE * u, states, round(1e9 * t))
        for t, u in zip(time_s, shown, strict=True)
    ]


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
