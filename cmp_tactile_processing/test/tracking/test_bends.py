"""What the corners around a corner say of how its edges bend, and what that moves."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.tracking.corners.bends import GridlineBends
from cmp_tactile_processing.tracking.corners.measured_markers import MeasuredCorners

SIDE_PX = 20.0
# How far a corner moves for each 1/px of its edges' bends, px^2: as of a window of 8 px.
PULL = 12.0
CERTAIN = 1e-6
# The parabola leans by up to 0.04; what is seen across it is less by the square.
LEAN = 0.06


def grid(rows=9, cols=11):
    """Corners of a straight grid, x along j, and the pull of edges along x and along y."""
    i, j = np.indices((rows, cols), dtype=np.float64)
    pull = np.zeros((rows, cols, 2, 4))
    # An edge along x that bends towards +y is expected on the +y side: the corner moves to -y.
    pull[..., 0, :] = (1, 0, 0, -PULL)
    pull[..., 1, :] = (0, 1, PULL, 0)
    return SIDE_PX * np.stack([j, i], axis=-1), pull


def moved(corners, pull, std=CERTAIN, lines=None):
    """What the corners' bends move them by, and those of virtual markers along rows and columns."""
    bends = GridlineBends(corners, np.full(corners.shape[:2], std), pull)
    if lines is not None:
        bends.add_markers(bends.corrected(), *lines)
    return bends.corrected() - corners


@pytest.mark.parametrize("backwards", [False, True])
def test_a_parabola_moves_its_corners_by_its_bend(backwards):
    """Whichever way the fit's edges point, also at both ends of a gridline."""
    corners, pull = grid()
    bend = 1e-4
    corners[..., 1] += bend * corners[..., 0] ** 2
    if backwards:
        pull = -pull
    shift = moved(corners, pull)
    np.testing.assert_allclose(shift[..., 1], -PULL * bend, rtol=LEAN**2)
    np.testing.assert_allclose(shift[..., 0], 0.0, atol=1e-4 * PULL * bend)


@pytest.mark.parametrize(
    ("height_px", "std"), [(0.01, CERTAIN), (1.0, CERTAIN), (1.0, 0.005), (1.0, 0.02)]
)
def test_a_crest_is_not_flattened(height_px, std):
    """A wave 3.7 checkers long, of which plain second differences see 0.79 of the bend.

    Nor is it where corners have usual noise, which is far below the wave.
    """
    corners, pull = grid(cols=21)
    wave = 2 * np.pi / (3.7 * SIDE_PX)
    corners[..., 1] += height_px * np.sin(wave * corners[..., 0] + 1.0)
    bend = -height_px / 2 * wave**2 * np.sin(wave * corners[..., 0] + 1.0)
    inner = np.s_[:, 2:-2]
    shift = moved(corners, pull, std)[..., 1]
    atol = 0.02 * PULL * height_px / 2 * wave**2
    np.testing.assert_allclose(shift[inner], -PULL * bend[inner], atol=atol)


def test_virtual_markers_show_how_a_gridline_bends_at_a_corner():
    """A wave 2.2 checkers long, of which corners alone show three quarters of the bend."""
    corners, pull = grid(cols=21)
    share = np.arange(1, 7) / 7
    wave, height = 2 * np.pi / (2.2 * SIDE_PX), 0.01

    def bent(points):
        return points + height * np.sin(wave * points[..., :1] + 1.0) * (0, 1)

    rows = corners[:, :-1, None] + SIDE_PX * share[:, None] * (1, 0)
    cols = corners[:-1, :, None] + SIDE_PX * share[:, None] * (0, 1)
    shift = moved(bent(corners), pull, lines=(bent(rows), bent(cols)))
    bend = -height / 2 * wave**2 * np.sin(wave * corners[..., 0] + 1.0)
    off = np.abs(shift[..., 1] + PULL * bend)[:, 2:-2].max() / np.abs(PULL * bend).max()
    assert off < 0.1


def test_a_ragged_edge_bends_no_corner():
    """Its virtual markers turn by more from checker to checker than any gel makes them."""
    corners, pull = grid(cols=21)
    ragged = np.random.default_rng(4).normal(0, 2.0, (9, 20, 6, 1)) * (0, 1)
    rows = corners[:, :-1, None] + SIDE_PX * np.arange(1, 7)[:, None] / 7 * (1, 0) + ragged
    cols = corners[:-1, :, None] + SIDE_PX * np.arange(1, 7)[:, None] / 7 * (0, 1)
    corners[..., 1] += 1e-4 * corners[..., 0] ** 2
    shift = moved(corners, pull, lines=(rows, cols))
    assert np.abs(shift[..., 1] - moved(corners, pull)[..., 1]).max() < 0.01 * SIDE_PX


def test_noise_is_not_taken_for_bends():
    """Of white noise, the means over five corners move a corner by a third of what bends would."""
    corners, pull = grid(rows=40, cols=40)
    noise = np.random.default_rng(3).normal(0, 0.05, corners.shape)
    believed = moved(corners + noise, pull, std=CERTAIN)
    known_as_noise = moved(corners + noise, pull, std=0.05)
    inner = np.s_[2:-2, 2:-2]
    assert known_as_noise[inner].std() < believed[inner].std() / 3
    # A corner's own error is not made larger by what it does to its own bend.
    own = np.corrcoef(known_as_noise[inner].ravel(), noise[inner].ravel())[0, 1]
    assert abs(own) < 0.1


def test_beside_missing_corners_the_next_ones_say_it():
    corners, pull = grid()
    bend = 1e-4
    corners[..., 1] += bend * corners[..., 0] ** 2
    corners[4, 5] = np.nan
    corners[7, 2:] = np.nan
    shift = moved(corners, pull)
    known = np.isfinite(corners[..., 0])
    assert np.isnan(shift[~known]).all()
    # Two corners that are left of a gridline say nothing of its bend.
    known[7] = False
    np.testing.assert_allclose(shift[known][:, 1], -PULL * bend, rtol=LEAN**2)
    np.testing.assert_allclose(shift[7, :2, 1], 0.0, atol=1e-12)


def test_a_corner_that_was_lost_and_found_otherwise_stays():
    """The pull of a rejected fit says nothing about a corner that was found there later."""
    corners, pull = grid()
    corners[..., 1] += 1e-4 * corners[..., 0] ** 2
    lost = np.zeros(corners.shape[:2], dtype=bool)
    lost[3, 3] = True
    std = np.full(corners.shape[:2], CERTAIN)
    left = MeasuredCorners(corners, std, np.zeros_like(lost), ~lost, pull).without(lost)
    assert not moved(corners, left.pull)[3, 3].any()
    np.testing.assert_array_equal(moved(corners, left.pull)[~lost], moved(corners, pull)[~lost])
