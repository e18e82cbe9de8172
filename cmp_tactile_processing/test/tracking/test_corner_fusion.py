"""A corner and the gridlines through it: fused by their covariances, or the lines have no say."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.tracking.virtual_markers.corner_fusion import (
    LINE_ENTRIES,
    MISLED,
    fused_corners,
    gather_lines,
)
from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    CORNER_BIAS_PX,
    SHARED_PIXELS_VARIANCE_RATIO,
    Fits,
)

STD, LINE_STD, LENGTH_PX = 0.01, 0.005, 20.0
AT_LINE = np.zeros((1, 3, 2))


def _gathered(offsets: tuple[float, float], slopes: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Of a gridline with three corners whose two segments see the middle one so far across, px.

    slopes: of the segments; across is to the left of a gridline that runs to the right.
    """
    curve = np.zeros((1, 2, 4, 2))
    curve[0, :, 1, 0], curve[0, :, 1, 1] = LENGTH_PX, LENGTH_PX * np.array(slopes)
    steep = np.abs(slopes) > 1
    # What a distance across the segment is along the image axis that it is measured along.
    tilt = np.hypot(1, slopes) / np.where(steep, np.abs(slopes), 1)
    fits = Fits.from_shape(2, 1)
    # As posteriors, in which the saddle is one of two measurements.
    weight, own = 1 / LINE_STD**2, 1 / STD**2
    fits.spread[:, :2] = tilt**2 / (weight + own)
    fits.mean[:] = 0.0
    seen = np.array(offsets) * np.where(steep, -tilt, tilt) * weight / (weight + own)
    fits.mean[-1, 0], fits.mean[0, 1] = seen
    found = np.empty((1, 3, LINE_ENTRIES))
    counts, size = np.array([5, 5]), np.array([[LENGTH_PX] * 2, tilt])
    gather_lines(curve, counts, size, np.full((2, 2), STD), fits, np.empty((1, 3, 2, 4)), found)
    return found


def test_a_line_moves_a_corner_across_itself_alone():
    """Two segments and the saddle are three measurements: their weighted mean, in closed form."""
    lines = _gathered((0.004, 0.008))
    corners, std = fused_corners(AT_LINE, np.full((1, 3), STD), AT_LINE, lines)
    weight, own = 1 / LINE_STD**2, 1 / STD**2
    assert corners[0, 1] == pytest.approx((0.0, weight * 0.012 / (2 * weight + own)), rel=1e-9)
    variances = 1 / own, 1 / (2 * weight + own)
    # Both share pixels, and the line takes out what a corner's deviation allows for bias.
    fused = SHARED_PIXELS_VARIANCE_RATIO * (np.mean(variances) - CORNER_BIAS_PX**2)
    assert std[0, 1] == pytest.approx(np.sqrt(fused), rel=1e-9)


def test_a_gridline_is_one_where_it_turns_from_flat_to_steep():
    """Its segments are measured along different image axes, and see the corner at one place."""
    lines = _gathered((0.012, 0.012), (0.99, 1.01))
    corners, _ = fused_corners(AT_LINE, np.full((1, 3), STD), AT_LINE, lines)
    weight, own = 1 / LINE_STD**2, 1 / STD**2
    across = 2 * weight * 0.012 / (2 * weight + own)
    assert corners[0, 1] == pytest.approx(across * np.sqrt(0.5) * np.array([-1, 1]), rel=0.01)


def test_a_corner_of_which_no_line_is_known_stays_as_it_is():
    std, nothing = np.array([[0.01, 0.02, 0.3]]), np.zeros((1, 3, LINE_ENTRIES))
    corners, fused = fused_corners(AT_LINE + 1.5, std, AT_LINE, nothing)
    np.testing.assert_array_equal(corners, AT_LINE + 1.5)
    np.testing.assert_array_equal(fused, std)


def test_lines_that_were_fitted_with_a_wrong_corner_say_less():
    """A corner is found to be 0.004 px from where its lines were fitted, which see it there."""
    lines, moved = _gathered((0.0, 0.0)), AT_LINE + (0.0, 0.004)
    std = np.full((1, 3), STD)
    corners, fused = fused_corners(moved, std, AT_LINE, lines)
    # To the variance of the lines comes that of what misled them.
    weight, own = 1 / (LINE_STD**2 / 2 + (MISLED * 0.004) ** 2), 1 / STD**2
    assert corners[0, 1, 1] == pytest.approx(0.004 * own / (weight + own))
    assert fused_corners(moved, std, moved, lines)[1][0, 1] < fused[0, 1] < STD


@pytest.mark.parametrize("offsets", [(0.02, -0.02), (0.06, 0.06)])
def test_a_line_that_kinks_or_misses_the_corner_has_no_say(offsets):
    assert np.count_nonzero(_gathered(offsets)[0, 1]) == 0
