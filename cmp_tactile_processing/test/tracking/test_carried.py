"""A pattern that goes on beyond the view keeps its numbers from frame to frame, or has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.tracker import GridTracker

# The print has 20 x 20 corners, of which the description numbers the middle ones.
NUMBERED, BESIDE = 12, 4
# The drawing smooths the checkers' edges to a quarter of a pixel: what its corners are off.
DRAWN_PX = 0.3


@pytest.fixture(scope="module")
def kept_tracker(sensor):
    part = replace(sensor.pattern, rows=NUMBERED, cols=NUMBERED, border="beyond_view")
    return GridTracker(replace(sensor, pattern=part), "left")


def along(nominal, rows=0.0, cols=0.0):
    """Displacement (20, 20, 2) px by so many checkers."""
    return rows * nominal.row_step + cols * nominal.col_step


def pressed(nominal, size_px=4.0):
    """Displacement (20, 20, 2) px of an object that presses the gel aside around the middle."""
    i, j = np.mgrid[-9.5:10, -9.5:10]
    size = size_px * np.exp(-(i**2 + j**2) / 40)
    return size[..., None] * np.stack([j, i], axis=-1) / 4


def wrong(grid, nominal, displacement):
    """Corners that are not where their numbers have them, and how many are known."""
    inner = slice(BESIDE, BESIDE + NUMBERED)
    truth = (nominal.corners + displacement)[inner, inner]
    error = np.linalg.norm(grid.corners - truth, axis=-1)
    known = np.isfinite(error)
    return int((error[known] > 5 * DRAWN_PX).sum()), int(known.sum())


def test_a_motion_that_speeds_up_beyond_half_a_checker_a_frame_is_expected(
    tracker, photograph, nominal
):
    place = 0.0
    for speed in (0.0, 0.2, 0.4, 0.6, 0.8):
        place += speed
        moved = along(nominal, cols=place)
        grid = tracker.track(photograph(moved))
        assert wrong(grid, nominal, moved) == (0, NUMBERED**2), speed


def test_corners_leave_the_view_and_come_back_while_the_others_are_followed(
    tracker, photograph, nominal
):
    missing = []
    for step in (*range(41), *range(40, -1, -1)):
        moved = along(nominal, rows=-0.2 * step)
        grid = tracker.track(photograph(moved))
        count, known = wrong(grid, nominal, moved)
        assert count == 0
        assert grid.followed == bool(missing), step
        missing.append(NUMBERED**2 - known)
    assert max(missing) > 2 * NUMBERED
    assert missing[-1] == 0


def test_a_jump_by_whole_checkers_loses_the_numbers_until_the_gel_is_back(
    tracker, photograph, nominal
):
    press = pressed(nominal)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        tracker.track(photograph(share * press))
    # The lattice looks as before, but the press has gone with it.
    jumped = press + along(nominal, cols=2.0)
    for _ in range(2):
        grid = tracker.track(photograph(jumped))
        assert grid.fault is GridFault.AMBIGUOUS
        assert wrong(grid, nominal, jumped) == (0, 0)
    grid = tracker.track(photograph(press))
    assert wrong(grid, nominal, press) == (0, NUMBERED**2)


def test_a_quick_press_keeps_its_numbers_while_it_is_held(tracker, photograph, nominal):
    i, j = np.mgrid[-9.5:10, -9.5:10]
    size = 4.0 * np.exp(-(i**2 + j**2) / 8)
    press = size[..., None] * np.array([1.0, 0.3])
    tracker.track(photograph(0.0))
    for _ in range(2):
        assert wrong(tracker.track(photograph(press)), nominal, press) == (0, NUMBERED**2)


def test_pieces_beside_what_hides_the_middle_bear_the_same_numbers(tracker, photograph, nominal):
    image = photograph(0.0)
    y = int(nominal.corners[10, 10, 1])
    image[y - 25 : y + 25] = 120
    grid = tracker.track(image)
    count, known = wrong(grid, nominal, 0.0)
    assert count == 0
    assert known > 0.6 * NUMBERED**2
    above, below = np.isfinite(grid.corners[:3, :, 0]), np.isfinite(grid.corners[-3:, :, 0])
    assert above.all()
    assert below.all()
    assert grid.fault is GridFault.PARTLY_HIDDEN


def test_the_first_frame_sets_the_numbers_and_a_reset_lets_the_next_one(
    tracker, photograph, nominal
):
    moved = along(nominal, rows=1.0, cols=1.0)
    first = tracker.track(photograph(moved))
    # The nearest corner of the right colours lies at the nominal place.
    count, known = wrong(first, nominal, moved)
    assert count == known == NUMBERED**2
    tracker.reset()
    assert wrong(tracker.track(photograph(0.0)), nominal, 0.0) == (0, NUMBERED**2)


def test_an_image_without_a_pattern_loses_the_numbers_and_finds_them_where_they_were(
    tracker, photograph, nominal
):
    tracker.track(photograph(0.0))
    dark = tracker.track(np.zeros_like(photograph(0.0)))
    assert dark.fault is GridFault.DARK
    moved = along(nominal, rows=0.1)
    assert wrong(tracker.track(photograph(moved)), nominal, moved) == (0, NUMBERED**2)
    tracker.track(np.zeros_like(photograph(0.0)))
    # Where one cannot know how far it has moved, one number is as good as the next.
    away = along(nominal, rows=0.6)
    assert tracker.track(photograph(away)).fault is GridFault.AMBIGUOUS


def test_a_pattern_that_is_turned_against_the_description_is_reported(tracker, photograph, nominal):
    centre = nominal.corners.reshape(-1, 2).mean(axis=0)
    angle = np.radians(15)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned = (nominal.corners - centre) @ turn.T + centre - nominal.corners
    grid = tracker.track(photograph(turned))
    assert grid.fault is GridFault.TURNED
    assert "15 degrees" in grid.reason or "-15 degrees" in grid.reason
