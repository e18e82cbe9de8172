"""What is made of the grasp's and the knocks' measurements."""

import numpy as np
import pytest

from paper.experiments.grasp import LIMIT, GraspScore, KnockScore

PHASES = np.array(["rest", "rest", "close", "drag", "knock", "hold", "knock back", "open"])
PEAK = 5.0


def grasp(**changes):
    """A faultless grasp but for what is changed: {frame: (error of Fx in N, share wrong)}."""
    count = len(PHASES)
    true = np.zeros((count, 6))
    true[2:, 2] = -PEAK
    true[2:, 4] = 0.02
    wrench, wrong = np.stack([true, true]), np.zeros((2, count))
    for frame, (off, share) in changes.get("bad", {}).items():
        wrench[1, frame, 0] += off
        wrong[1, frame] = share
    return {"phase": PHASES, "wrench": true, "x_wrench": wrench, "x_wrong": wrong}


def test_force_error_is_given_in_the_stage_it_comes_in_as_a_share_of_the_peak():
    score = GraspScore.from_arrays(grasp(bad={4: (2.0, 0.0)}), "x")
    assert score.largest_in("disturbance") == pytest.approx(2.0 / PEAK)
    assert score.largest_in("clamping") == 0


@pytest.mark.parametrize(("share", "bad"), [(0.99, False), (1.01, True), (np.nan, True)])
def test_a_force_beyond_the_limit_or_none_is_bad(share, bad):
    score = GraspScore.from_arrays(grasp(bad={4: (share * LIMIT * PEAK, 0.0)}), "x")
    assert score.bad[4] == bad


def knocked(jump, wrong=0.0, found=1.0, force=0.0):
    return [jump, wrong, found, force]


def test_failing_jump_is_the_smallest_with_a_wrong_number_whatever_the_order():
    rows = [knocked(1.0, wrong=0.2), knocked(0.4), knocked(0.6, wrong=0.1), knocked(0.8)]
    score = KnockScore.from_knocks([np.array(rows)])
    assert score.misnumbers_from == pytest.approx(0.6)
    assert score.holds_up_to == pytest.approx(0.4)
    assert score.fails_from is None


def test_a_force_beyond_the_limit_or_none_fails_without_wrong_numbers():
    rows = np.array([knocked(0.5), knocked(1.0, force=2 * LIMIT), knocked(2.0, force=np.nan)])
    score = KnockScore.from_knocks([rows])
    assert score.fails_from == pytest.approx(1.0)
    assert score.misnumbers_from is None
    assert score.holds_up_to == pytest.approx(0.5)
