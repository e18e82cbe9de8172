"""Torn frames and a second pattern: what is numbered is right, and the fault says so.

That whole frames are never called torn: test/test_whole_frames.py.

Reports of the kind, tried here:
jvdillon/p3-ir-camera 5 (half of a picture is the frame before): a knock in the middle of a frame;
seen, as before.
cirquit/trdrop 17 (tears are seen only where the frame is cut in two, not around a band): a band
of another frame; seen.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import GridFault, Status
from cmp_tactile_processing.tracking.detector import draw_nominal
from cmp_tactile_processing.tracking.tracker import GridTracker

# A corner is misnumbered within this share of a checker's side of another corner.
ANOTHER = 0.35
SAYS_SO = {GridFault.TWO_PATTERNS, GridFault.AMBIGUOUS, GridFault.OTHER_SIZE}
NOISE_SEED = 5
DATA = Path(__file__).parent.parent / "data"
# The image row of the tear, as a share of the pattern's height.
SHARES = [0.1, 0.35, 0.5, 0.8]


@pytest.fixture(scope="module")
def trackers(sensor):
    rigs = {
        detector: replace(sensor, tracking=replace(sensor.tracking, detector=detector))
        for detector in ("saddle_lattice", "contour_stitching")
    }
    return {detector: GridTracker(rig, "left") for detector, rig in rigs.items()}


@pytest.fixture(scope="module")
def photograph(sensor, nominal):
    """Draws the pattern moved along i and j by checkers; returns its corners, too."""
    place = build_views(sensor)["left"].placement
    rng = np.random.default_rng(NOISE_SEED)

    @cache
    def draw(di=0.0, dj=0.0):
        corners = nominal.corners + di * nominal.row_step + dj * nominal.col_step
        moved = replace(nominal, corners=corners)
        picture = draw_nominal(moved, (place.height, place.width), dark_first=True)
        noisy = picture + rng.normal(0, 1.5, picture.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), corners

    return draw


def row_at(nominal, share):
    low, high = nominal.corners[..., 1].min(), nominal.corners[..., 1].max()
    return int(low + share * (high - low))


def torn(upper, lower, row):
    """The image, and where it shows each corner in either part, NaN where it does not."""
    image = np.concatenate([upper[0][:row], lower[0][row:]])
    above, below = upper[1].copy(), lower[1].copy()
    above[above[..., 1] >= row] = np.nan
    below[below[..., 1] < row] = np.nan
    return image, np.stack([above, below])


def misnumbered(grid, places, side):
    flat = places.reshape(-1, 2)
    shown = np.flatnonzero(np.isfinite(flat[:, 0]))
    known = np.isfinite(grid.corners[..., 0])
    distance, nearest = cKDTree(flat[shown]).query(grid.corners[known])
    other = shown[nearest] % known.size != np.flatnonzero(known)
    return int((other & (distance < ANOTHER * side)).sum())


@pytest.mark.parametrize("detector", ["saddle_lattice", "contour_stitching"])
@pytest.mark.parametrize("moved", [(0, 2), (0, -2), (2, 0), (1, 1), (0.3, 1.8), (0.5, 0.5)])
def test_a_knock_in_the_middle_of_a_frame(trackers, photograph, nominal, detector, moved):
    """By whole checkers the gridlines go on, or nearly so: only the border and one row show it."""
    tracker, rest, knocked = trackers[detector], photograph(), photograph(*moved)
    for number, share in enumerate(SHARES):
        image, places = torn(knocked, rest, row_at(nominal, share))
        tracker.reset()
        if number % 2:
            tracker.track(rest[0])
        grid = tracker.track(image)
        assert misnumbered(grid, places, nominal.side_px) == 0, share
        assert grid.fault in SAYS_SO, share
        assert not grid.followed, share


def test_the_larger_part_is_numbered_and_the_reason_says_why_the_other_is_not(
    trackers, photograph, nominal
):
    row = row_at(nominal, 0.3)
    image, places = torn(photograph(0.3, 1.8), photograph(), row)
    tracker = trackers["saddle_lattice"]
    tracker.reset()
    grid = tracker.track(image)
    known = np.isfinite(grid.corners[..., 0])
    clear = places[1][..., 1] > row + nominal.side_px
    assert known[clear].mean() > 0.95
    assert (grid.corners[known][:, 1] > row).all()
    assert grid.fault is GridFault.TWO_PATTERNS
    assert "torn" in grid.reason


def test_a_band_of_another_frame_in_the_middle(trackers, photograph, nominal):
    """Torn twice: rest above and below belong together, the band between does not."""
    rest, knocked = photograph(), photograph(0.3, 1.8)
    first, last = row_at(nominal, 0.4), row_at(nominal, 0.6)
    upper, places = torn(rest, knocked, first)
    image = np.concatenate([upper[:last], rest[0][last:]])
    places[1][places[1][..., 1] >= last] = np.nan
    below = rest[1].copy()
    below[below[..., 1] < last] = np.nan
    for tracker in trackers.values():
        tracker.reset()
        grid = tracker.track(image)
        assert misnumbered(grid, np.stack([*places, below]), nominal.side_px) == 0
        assert grid.fault in SAYS_SO


def test_a_thin_bar_along_rows_is_not_taken_for_a_tear(trackers, photograph, nominal):
    """What is above and below continues each other: all but what it hides is numbered."""
    image, corners = (array.copy() for array in photograph())
    row = row_at(nominal, 0.5)
    cv2.rectangle(image, (0, row), (image.shape[1], row + 5), 255, -1)
    tracker = trackers["saddle_lattice"]
    tracker.reset()
    grid = tracker.track(image)
    assert misnumbered(grid, corners[None], nominal.side_px) == 0
    clear = np.abs(corners[..., 1] - row - 2.5) > nominal.side_px
    assert np.isfinite(grid.corners[clear]).all()
    assert grid.fault in {GridFault.NONE, GridFault.PARTLY_HIDDEN}


def test_gel_that_a_small_ball_drags_is_no_other_pattern(trackers, photograph, nominal):
    """From corner to corner it moves by up to 0.8 sides, and the gridlines go on."""
    (image, corners), side = photograph(), nominal.side_px
    y, x = np.indices(image.shape, dtype=np.float32)
    at, reach = corners[9, 10] + 0.3 * side, 2.2 * side
    drag = 1.2 * side * np.array([0.8, 0.6])

    def bump(points):
        away = np.linalg.norm(points - at, axis=-1) / reach
        return np.exp(-(away**4))[..., None] * drag

    # The picture is looked up where a pixel came from: the fixed point of its own displacement.
    pixels = np.stack([x, y], axis=-1)
    origin = pixels
    for _ in range(40):
        origin = pixels - bump(origin)
    dragged = cv2.remap(image, *np.moveaxis(origin.astype(np.float32), -1, 0), cv2.INTER_CUBIC)
    tracker = trackers["saddle_lattice"]
    tracker.reset()
    tracker.track(image)
    grid = tracker.track(dragged)
    off = np.linalg.norm(grid.corners - (corners + bump(corners)), axis=-1) / side
    assert np.isfinite(off).all()
    assert off.max() < 0.1
    assert grid.fault is GridFault.NONE


BOARD_CHECKERS = 9
BLUR_PX = 0.8


def pasted(image, board_px, turn, corner):
    """The image with a board of that checker's side, turned (rad), from a corner (x, y) px."""
    y, x = np.indices(image.shape, dtype=np.float64)
    x, y = x - corner[0], y - corner[1]
    along, across = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    i, j = np.floor(across / board_px), np.floor(along / board_px)
    inside = (i >= 0) & (j >= 0) & (i < BOARD_CHECKERS) & (j < BOARD_CHECKERS)
    levels = np.percentile(image, (5, 95))
    board = np.where((i + j) % 2 == 0, *levels)
    blurred = cv2.GaussianBlur(np.where(inside, board, image), (0, 0), BLUR_PX)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("share", [0.75, 0.85, 1.15])
@pytest.mark.parametrize("place", [(2, 2), (8, 6)])
def test_a_board_of_similar_pitch_over_the_view_gets_no_numbers(
    trackers, photograph, nominal, share, place
):
    (image, corners), side = photograph(), nominal.side_px
    for number, phase in enumerate(np.linspace(0, 1, 4, endpoint=False)):
        corner = corners[place] - (5 + phase) * side
        tracker = trackers["saddle_lattice"]
        tracker.reset()
        grid = tracker.track(pasted(image, share * side, 0.05 * number, corner))
        off = np.linalg.norm(grid.corners - corners, axis=-1) / side
        # Half a side off a corner bears a wrong number.
        assert not (off > 0.5).any()
        assert grid.fault is not GridFault.NONE


@pytest.mark.parametrize("line", [2, 6, 10])
def test_rows_rolled_at_the_last_gridline_are_noticed(sensor, line):
    """Too few corners lie beyond the row to show a jump, and a gridline lies along it."""
    image = cv2.imread(str(DATA / "rest.png"), cv2.IMREAD_GRAYSCALE)
    view = build_views(sensor)["left"]
    whole = GridTracker(sensor, "left").track(split_frame(image, view.placement))
    row = round(float(whole.corners_frame[..., 1].max())) - line
    rolled = image.copy()
    rolled[row:] = np.roll(image[row:], -253, axis=1)
    grid = GridTracker(sensor, "left").track(split_frame(rolled, view.placement))
    assert grid.fault is not GridFault.NONE
    below = whole.corners_frame[..., 1] > row
    assert (grid.corner_status[below] != Status.MEASURED).all()
