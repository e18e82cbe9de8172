"""What is made of the grasp's and the knocks' measurements."""

from __future__ import annotations

import numpy as np
import pytest

from paper.experiment import Workplace
from paper.experiments.grasp import (
    COLUMNS,
    DIRECTIONS,
    StrokePath,
    cases,
    grasp_scene,
    stroke_scene,
)
from paper.experiments.grasp_report import LIMIT, GraspScore, KnockScore, largest_held

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
    return {
        "phase": PHASES,
        "true_wrench": true,
        "x.wrench": wrench,
        "x.wrong": wrong,
        "x.found": np.ones((2, count)),
        "x.flags": changes.get("flags", np.zeros((2, count), int)),
    }


def test_faultless_grasp_has_no_bad_frame():
    score = GraspScore.from_arrays(grasp(), "x")
    assert score.first_bad is None
    assert score.frames_wrong == 0
    assert score.error_in("disturbance").largest == 0


def test_force_error_is_given_in_the_stage_it_comes_in_as_a_share_of_the_peak():
    score = GraspScore.from_arrays(grasp(bad={4: (2.0, 0.0)}), "x")
    assert score.error_in("disturbance").largest == pytest.approx(2.0 / PEAK)
    # Three frames of two draws, of which one is off.
    assert score.error_in("disturbance").rms == pytest.approx(2.0 / PEAK / np.sqrt(6))
    assert score.error_in("clamping").largest == 0


def test_bad_frames_are_those_of_any_draw_and_end_where_all_is_well_again():
    score = GraspScore.from_arrays(grasp(bad={4: (2.0, 0.1), 5: (0.0, 0.1)}), "x")
    assert (score.first_bad, score.good_again, score.frames_wrong) == (4, 6, 2)


def test_a_bad_frame_is_warned_of_where_every_draw_is_flagged():
    flags = np.zeros((2, len(PHASES)), int)
    flags[:, [3, 4]] = 128
    flags[0, 5] = 128
    score = GraspScore.from_arrays(grasp(bad={4: (2.0, 0.1), 5: (2.0, 0.1)}, flags=flags), "x")
    assert score.warned == 1


def test_what_is_bad_to_the_end_is_never_good_again():
    assert GraspScore.from_arrays(grasp(bad={7: (2.0, 0.0)}), "x").good_again is None


def test_an_error_below_the_limit_is_not_bad_and_one_above_is():
    assert GraspScore.from_arrays(grasp(bad={4: (0.99 * LIMIT * PEAK, 0.0)}), "x").first_bad is None
    assert GraspScore.from_arrays(grasp(bad={4: (1.01 * LIMIT * PEAK, 0.0)}), "x").first_bad == 4


def test_a_frame_without_force_is_bad_but_no_error():
    score = GraspScore.from_arrays(grasp(bad={4: (np.nan, 0.0)}), "x")
    assert score.first_bad == 4
    assert score.error_in("disturbance").largest == 0


def knocked(jump, wrong=0.0, force=0.0, **others):
    data = dict.fromkeys(COLUMNS, 0.0) | {"found": 1.0, "found_after": 1.0}
    data |= {"jump": jump, "wrong": wrong, "force": force} | others
    return [data[name] for name in COLUMNS]


def test_failing_jump_is_the_smallest_with_a_wrong_number_whatever_the_order():
    rows = [knocked(1.0, wrong=0.2), knocked(0.4), knocked(0.6, wrong=0.1), knocked(0.8)]
    score = KnockScore.from_knocks(np.array([rows]))
    assert score.misnumbers_from == pytest.approx(0.6)
    assert largest_held(score) == pytest.approx(0.4)
    assert score.always_misnumbers_from == pytest.approx(1.0)
    assert score.fails_from is None


def test_a_force_beyond_the_limit_or_none_fails_without_wrong_numbers():
    rows = np.array([knocked(0.5), knocked(1.0, force=2 * LIMIT), knocked(2.0, force=np.nan)])
    score = KnockScore.from_knocks(rows)
    assert score.fails_from == pytest.approx(1.0)
    assert score.misnumbers_from is None
    assert largest_held(score) == pytest.approx(0.5)


def test_all_knocks_held_is_shown_by_the_largest():
    score = KnockScore.from_knocks(np.array([knocked(0.5), knocked(3.0)]))
    assert largest_held(score) == pytest.approx(3.0)
    assert score.always_misnumbers_from is None


def path():
    frames = np.arange(10, 71)
    return StrokePath((0, 2, 4), frames, np.linspace(-1.5, 1.5, 61))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("size", [0.2, 1.0, 3.0])
def test_a_knock_goes_by_its_size_and_begins_where_the_approach_ends(size, sign):
    stroke = path()
    first, last = stroke.knock(size, sign)
    travel = dict(zip(stroke.frames.tolist(), stroke.travel, strict=True))
    assert travel[last] - travel[first] == pytest.approx(sign * size, abs=0.051)
    approach = stroke.to_start(-sign * size / 2)
    assert approach[-1] == first
    steps = np.abs(np.diff([travel[f] for f in approach[3:]]))
    assert steps.max() <= 0.2 + 0.051


def test_scenes_keep_the_knock_within_one_frame_and_the_stroke_is_even(tmp_path):
    for fast in (False, True):
        place = Workplace(tmp_path, fast)
        phases = {phase.name: phase for phase in grasp_scene(place).motion}
        assert phases["knock"].frames == phases["knock back"].frames == 1
        for direction in DIRECTIONS:
            assert stroke_scene(place, direction).motion[-1].easing == "linear"


def test_cases_have_names_of_their_own_and_the_quick_run_fewer(tmp_path):
    full, fast = (cases(Workplace(tmp_path, quick)) for quick in (False, True))
    names = [case.name for case in full]
    assert len(set(names)) == len(names)
    assert {case.name for case in fast} < set(names)
