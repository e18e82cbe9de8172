"""A corner and the gridlines through it: fused by their covariances, or the lines have no say."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.tracking.virtual_markers.corner_fusion import (
    LINE_ENTRIES,
    fused_corners,
    gather_lines,
)
from cmp_tactile_processing.tracking.virtual_markers.fusion import (
    CORNER_BIAS_PX,
    SHARED_PIXELS,
    Fits,
)

STD, LINE_STD, LENGTH_PX = 0.01, 0.005, 20.0
AT_LINE = np.zeros((1, 3, 2))


def _gathered(offsets: tuple[float, float], slope: float = 0.0) -> np.ndarray:
    """Of a gridline with three corners whose two segments see the middle one so far across, px."""
    curve = np.zeros((1, 2, 4, 2))
    curve[0, :, 1] = LENGTH_PX, slope * LENGTH_PX
    fits = Fits.from_shape(2, 1)
    # As posteriors, in which the saddle is one of two measurements.
    weight, own = 1 / LINE_STD**2, 1 / STD**2
    fits.spread[:] = 1 / (weight + own)
    fits.mean[:] = 0.0
    fits.mean[-1, 0], fits.mean[0, 1] = np.array(offsets) * weight / (weight + own)
    found = np.empty((1, 3, LINE_ENTRIES))
    counts, size = np.array([5, 5]), np.array([[LENGTH_PX] * 2, [1.0] * 2])
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
    fused = SHARED_PIXELS * (np.mean(variances) - CORNER_BIAS_PX**2)
    assert std[0, 1] == pytest.approx(np.sqrt(fused), rel=1e-9)


def test_lines_that_were_fitted_with_a_wrong_corner_say_less():
    """A corner is found to be 0.004 px from where its lines were fitted, which see it there."""
    lines, moved = _gathered((0.0, 0.0)), AT_LINE + (0.0, 0.004)
    std = np.full((1, 3), STD)
    corners, fused = fused_corners(moved, std, AT_LINE, lines)
    weight, own = 2 / LINE_STD**2, 1 / STD**2
    trusted = 0.004 * own / (weight + own)
    assert 2 * trusted < corners[0, 1, 1] < 0.004
    assert fused_corners(moved, std, moved, lines)[1][0, 1] < fused[0, 1] < STD


@pytest.mark.parametrize("offsets", [(0.02, -0.02), (0.06, 0.06)])
def test_a_line_that_kinks_or_misses_the_corner_has_no_say(offsets):
    assert np.count_nonzero(_gathered(offsets)[0, 1]) == 0
