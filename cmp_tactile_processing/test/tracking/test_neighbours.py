"""A second checkerboard over a drawn view: none of its corners gets a number of the gel's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.detector import NominalGrid, draw_nominal
from cmp_tactile_processing.tracking.tracker import GridTracker

# A corner farther than this from its true place bears a wrong number, in sides.
WRONG = 0.5
BOARD_CHECKERS = 9
BLUR_PX = 0.8


@pytest.fixture(scope="module")
def view(sensor):
    """The left view at rest (H, W) float32, its corners (rows, cols, 2) px, a checker's side."""
    geometry = build_views(sensor)["left"]
    nominal = NominalGrid.of_view(sensor.pattern, geometry)
    shape = geometry.placement.height, geometry.placement.width
    image = draw_nominal(nominal, shape, sensor.pattern.corner_checker == "dark")
    return image.astype(np.float32), nominal.corners, nominal.side_px


@pytest.fixture(scope="module")
def tracker(sensor):
    return GridTracker(sensor, "left")


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
def test_a_board_of_similar_pitch_gets_no_numbers(view, tracker, share, place):
    image, corners, side = view
    for number, phase in enumerate(np.linspace(0, 1, 4, endpoint=False)):
        corner = corners[place] - (5 + phase) * side
        tracker.reset()
        grid = tracker.track(pasted(image, share * side, 0.05 * number, corner))
        off = np.linalg.norm(grid.corners - corners, axis=-1) / side
        assert not (off > WRONG).any()
        assert grid.fault is not GridFault.NONE
