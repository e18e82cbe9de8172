"""The overlay shows what was found, what was not, and why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.drawing import CORNER_COLOURS, ROW_COLOUR, draw_grid
from cmp_tactile_processing.measured import Grid, GridFault, GridShape, Status

SHAPE = GridShape(4, 5, 3)
SIDE_PX = 20


def _grid() -> Grid:
    """Corner (i, j) at pixel (40 + 20 j, 30 + 20 i)."""
    rows, cols = np.mgrid[:4, :5]
    corners = np.stack([40 + SIDE_PX * cols, 30 + SIDE_PX * rows], axis=-1).astype(float)
    steps = (np.arange(3) + 1.0) * SIDE_PX / 4
    row_lines = corners[:, :-1, None] + np.stack([steps, 0 * steps], axis=-1)
    col_lines = corners[:-1, :, None] + np.stack([0 * steps, steps], axis=-1)
    return Grid(
        shape=SHAPE,
        corners=corners,
        corner_status=np.ones(SHAPE.corners, np.uint8),
        row_lines=row_lines,
        row_line_status=np.ones(SHAPE.row_lines, np.uint8),
        col_lines=col_lines,
        col_line_status=np.ones(SHAPE.col_lines, np.uint8),
    )


def _pixel(image: np.ndarray, point: np.ndarray) -> tuple[int, ...]:
    x, y = np.rint(point).astype(int)
    return tuple(image[y, x].tolist())


@pytest.fixture
def grey() -> np.ndarray:
    return np.full((160, 200), 90, np.uint8)


def test_corners_have_the_colour_of_their_status_and_virtual_markers_are_dots(grey):
    grid = _grid()
    grid.corner_status[1, 2] = Status.PREDICTED
    image = draw_grid(grey, grid)
    assert _pixel(image, grid.corners[1, 2]) == CORNER_COLOURS[Status.PREDICTED]
    assert _pixel(image, grid.corners[2, 2]) == CORNER_COLOURS[Status.MEASURED]
    assert _pixel(image, grid.row_lines[0, 0, 1]) == ROW_COLOUR
    between = _pixel(image, (grid.row_lines[0, 0, 0] + grid.row_lines[0, 0, 1]) / 2)
    assert between not in (ROW_COLOUR, (90, 90, 90)), "the line is drawn, and pale"
    assert (grey == 90).all(), "the image is not drawn into"


def test_an_absent_corner_has_a_cross_and_no_line(grey):
    grid = _grid()
    place = grid.corners[1, 2].copy()
    grid.corners[1, 2] = np.nan
    grid.corner_status[1, 2] = Status.MISSING
    grid.row_lines[1, 1:3] = np.nan
    grid.col_lines[0:2, 2] = np.nan
    image = draw_grid(grey, grid).astype(int)
    around = image[int(place[1]) - 3 : int(place[1]) + 4, int(place[0]) - 3 : int(place[0]) + 4]
    blue, green, red = np.moveaxis(around, -1, 0)
    assert (red > green + 80).any()
    assert (red > blue + 80).any()
    assert _pixel(image, place + (-8, 0)) == (90, 90, 90)


def _red_rows(image: np.ndarray) -> np.ndarray:
    """Rows with pixels of ABSENT_COLOUR, at least as far as the smoothing of letters leaves it."""
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    return np.flatnonzero(((red > green + 60) & (red > blue + 60)).any(axis=1))


def test_nothing_found_is_reported_in_words_that_fit_the_image(grey):
    grid = Grid.missing(SHAPE, "too dark – " + "very " * 20, fault=GridFault.DARK)
    rows = _red_rows(draw_grid(grey, grid))
    assert rows.size
    assert np.ptp(rows) > 30, "a long reason takes several lines"
    corners_alone = replace(_grid(), confidence=0.5, followed=True)
    assert not _red_rows(draw_grid(grey, corners_alone)[120:]).size


def test_points_far_outside_are_left_out(grey):
    grid = _grid()
    moved = replace(grid, corners=grid.corners + 1e9, row_lines=grid.row_lines - 1e12)
    assert draw_grid(grey, moved).shape == (160, 200, 3)
