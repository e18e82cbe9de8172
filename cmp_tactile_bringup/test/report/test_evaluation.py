"""The numbers against the truth, and that each check can fail."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_bringup.report.evaluation import LIMITS, evaluate, table_rows
from cmp_tactile_bringup.report.results import DemoResults

CORNERS_PER_FRAME = 2 * 20 * 20


def changed(results: DemoResults, number: int, part: str, **changes) -> DemoResults:
    """The results with fields of one part of one frame replaced."""
    frames = list(results.frames)
    frame = frames[number]
    frames[number] = replace(frame, **{part: replace(getattr(frame, part), **changes)})
    return replace(results, frames=tuple(frames))


def with_grid(results: DemoResults, number: int, **changes) -> DemoResults:
    """The results with fields of the left grid of one frame replaced."""
    return changed(results, number, "left", **changes)


def missed(results: DemoResults) -> set[str]:
    rows = table_rows(results, evaluate(results))
    return {row.name for row in rows if row.passed is False}


def test_real_frames_keep_the_limits_but_for_those_left_out(results):
    evaluation = evaluate(results)
    assert evaluation.corners_found == CORNERS_PER_FRAME * len(results.frames)
    assert evaluation.corners_misnumbered == 0
    assert evaluation.corner_rmse_px <= LIMITS.corner_rmse_px
    assert evaluation.position_mean_um <= LIMITS.position_mean_um
    came = {frame.index for frame in results.frames}
    assert set(evaluation.lost_frames) == set(range(20)) - came
    assert missed(results) == {"Frames lost", "Corners not found"}


def test_a_known_shift_is_the_error_that_is_found(results):
    # 1 px along x in one of ten grids adds 1/10 to the mean square, up to the real errors.
    before = evaluate(results).corner_rmse_px
    shifted = with_grid(results, 0, corners=results.frames[0].left.corners + (1.0, 0.0))
    assert evaluate(shifted).corner_rmse_px == pytest.approx(np.sqrt(before**2 + 0.1), abs=0.005)
    assert "Corner error, RMS" in missed(shifted)


def test_numbers_off_by_one_column_are_wrong_numbers(results):
    grid = results.frames[2].left
    rolled = with_grid(results, 2, corners=np.roll(grid.corners, 1, axis=1))
    assert evaluate(rolled).corners_misnumbered == 20 * 20
    assert "Corners wrongly numbered" in missed(rolled)


def test_corners_that_are_missing_or_predicted_are_not_found_and_have_no_error(results):
    grid = results.frames[1].left
    corners, status = grid.corners.copy(), grid.corner_status.copy()
    corners[3, 4], status[3, 4] = np.nan, 0
    # One that was predicted does not count as found either.
    status[0, 0] = 2
    holed = with_grid(results, 1, corners=corners, corner_status=status)
    before, after = evaluate(results), evaluate(holed)
    assert after.corners_found == before.corners_found - 2
    assert after.corner_rmse_px == pytest.approx(before.corner_rmse_px, rel=0.01)


def test_a_lifted_surface_is_a_3d_error_and_a_displacement_error(results):
    surface, lift = results.frames[0].surface, np.array([0.0, 0.0, 100e-6])
    moved = {"position": surface.position + lift, "displacement": surface.displacement + lift}
    lifted = evaluate(changed(results, 0, "surface", **moved))
    # 100 um in one of five frames, up to its own error.
    before = evaluate(results).position_mean_um
    assert lifted.position_mean_um == pytest.approx(0.8 * before + 20.0, abs=1.0)
    assert lifted.displacement_mean_um == pytest.approx(lifted.position_mean_um, abs=0.1)


def test_nothing_received_passes_no_limit(results):
    nothing = replace(results, frames=())
    assert missed(nothing) == {
        "Frames lost",
        "Corners not found",
        "Corner error, RMS",
        "3-D error, mean",
        "Fz error, RMS, of the largest Fz",
    }


def test_only_what_was_measured_is_in_the_table(results):
    names = [row.name for row in table_rows(results, evaluate(results))]
    assert "Latency, frame to grids" in names
    assert "Latency, frame to wrench" not in names
    assert "Rate" not in names


def with_force(results: DemoResults, number: int, **changes) -> DemoResults:
    """The results with fields of the force of one frame replaced."""
    return changed(results, number, "force", **changes)


def test_a_force_that_is_off_is_found_in_its_component(results):
    before = evaluate(results).force
    assert before.normal_share < 0.05
    wrench = results.frames[2].force.wrench + np.array([0, 0, 5.0, 0, 0, 1e-2])
    after = evaluate(with_force(results, 2, wrench=wrench)).force
    # 5 N and 10 N mm in one of five frames.
    assert after.wrench_rms[2] == pytest.approx(5 / np.sqrt(5), rel=0.05)
    assert after.wrench_rms[5] == pytest.approx(1e-2 / np.sqrt(5), rel=0.05)
    np.testing.assert_array_equal(after.wrench_rms[:2], before.wrench_rms[:2])
    name = "Fz error, RMS, of the largest Fz"
    assert name not in missed(results)
    assert name in missed(with_force(results, 2, wrench=wrench))


def test_a_force_that_is_not_known_passes_no_limit(results):
    unknown = with_force(results, 1, wrench=np.full(6, np.nan), contact_area=np.nan)
    assert "Fz error, RMS, of the largest Fz" in missed(unknown)
    assert np.isnan(evaluate(unknown).force.area_rms)


def test_contact_area_is_compared(results):
    true = results.recording.truth.contact_area
    exact = results
    for number, frame in enumerate(results.frames):
        exact = with_force(exact, number, contact_area=float(true[frame.index]))
    assert evaluate(exact).force.area_rms == 0
    wider = with_force(exact, 2, contact_area=float(true[results.frames[2].index]) + 10e-6)
    assert evaluate(wider).force.area_rms == pytest.approx(10e-6 / np.sqrt(5))
    assert evaluate(wider).force.area_peak == true.max()


def test_truth_within_the_error_bar_is_counted_component_by_component(results):
    """2 deviations to either side; frames without an error bar do not count."""
    std = np.array([0.1, 0.1, 0.2, 1e-3, 1e-3, 1e-3])
    shifted = results
    for number, offset in enumerate((0.0, 1.9, -1.9, 2.1, -9.0)):
        true = results.recording.truth.wrench[results.frames[number].index]
        shifted = with_force(
            shifted,
            number,
            wrench=true + offset * std,
            wrench_covariance=np.diag(std**2),
            systematic_covariance=np.zeros((6, 6)),
        )
    force = evaluate(shifted).force
    np.testing.assert_allclose(force.wrench_inside, 0.6)
    np.testing.assert_array_equal(force.wrench_known, 5)
    unknown = with_force(shifted, 4, wrench_covariance=np.full((6, 6), np.nan))
    np.testing.assert_allclose(evaluate(unknown).force.wrench_inside, 0.75)
    rows = {row.name: row.value for row in table_rows(unknown, evaluate(unknown))}
    assert rows["My error, RMS"].endswith("within ±2 std in 75% of 4 frames")
