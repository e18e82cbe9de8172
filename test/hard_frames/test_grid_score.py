"""The yardstick itself: what is right scores right, and each kind of error is reported."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.measured import Grid, GridShape, Status
from hard_frames.grid_score import score_grid

SIDE_PX = 20.0
SHAPE = GridShape(6, 9, 3)
# Arcs of 300 px cut into chords of 0.6 px.
LINE_PX = 3e-4


def bent(shape=SHAPE):
    """A grid whose rows are arcs around a centre far above and whose columns are its rays."""
    radius, centre = 300.0, np.array([100.0, -250.0])

    def at(i, j):
        angle = (j - 4) * SIDE_PX / radius
        return centre + (radius + SIDE_PX * i)[..., None] * np.stack(
            [np.sin(angle), np.cos(angle)], axis=-1
        )

    part = np.arange(1, shape.points_per_segment + 1) / (shape.points_per_segment + 1)
    rows, cols = np.arange(float(shape.rows)), np.arange(float(shape.cols))
    zero = np.zeros(shape.points_per_segment)
    grid = Grid.missing(shape, "")
    return replace(
        grid,
        corners=at(*np.meshgrid(rows, cols, indexing="ij")),
        corner_status=np.full_like(grid.corner_status, Status.MEASURED),
        row_lines=at(
            rows[:, None, None] + zero + 0 * cols[:-1, None],
            0 * rows[:, None, None] + cols[:-1, None] + part,
        ),
        row_line_status=np.full_like(grid.row_line_status, Status.MEASURED),
        col_lines=at(
            rows[:-1, None, None] + part + 0 * cols[:, None],
            0 * rows[:-1, None, None] + cols[:, None] + zero,
        ),
        col_line_status=np.full_like(grid.col_line_status, Status.PREDICTED),
    )


@pytest.fixture(scope="module")
def truth():
    return bent()


@pytest.fixture(scope="module")
def seen():
    return np.ones(SHAPE.corners, np.bool_)


def test_virtual_markers_count_across_their_line_alone(truth, seen):
    """Other points along the same arcs lie on the line; points moved off it do not."""
    other = bent(GridShape(6, 9, 5))
    score = score_grid(other, truth, seen, seen)
    assert score.virtual.max() < LINE_PX
    moved = replace(truth, row_lines=truth.row_lines + (0.0, 0.3))
    off = score_grid(moved, truth, seen, seen).measured
    # Rows run askew by up to 16 degrees.
    assert 0.3 * np.cos(np.radians(16)) - LINE_PX < off.min() <= off.max() < 0.3 + LINE_PX


@pytest.mark.parametrize("shift", [(1, 0), (0, 1), (-2, 0), (0, -2), (1, 1)])
def test_a_lattice_shifted_by_whole_checkers_is_all_wrong(truth, seen, shift):
    corners = np.full_like(truth.corners, np.nan)
    rows, cols = (slice(max(n, 0), n if n < 0 else None) for n in shift)
    from_rows, from_cols = (slice(max(-n, 0), -n if n > 0 else None) for n in shift)
    corners[rows, cols] = truth.corners[from_rows, from_cols]
    given = np.isfinite(corners[..., 0])
    grid = replace(truth, corners=corners, corner_status=given.astype(np.uint8))
    score = score_grid(grid, truth, seen, seen)
    assert score.wrong == given.sum() > 0
    assert score.found_visible == score.complete == 0


def test_a_predicted_corner_can_be_wrong_and_is_not_found(truth, seen):
    corners, status = truth.corners.copy(), truth.corner_status.copy()
    corners[2, 3] += 0.6 * SIDE_PX
    status[2, 3] = status[4, 4] = Status.PREDICTED
    score = score_grid(replace(truth, corners=corners, corner_status=status), truth, seen, seen)
    assert score.wrong == 1
    assert (score.found_visible, score.filled) == (52, 1)


def test_what_cannot_be_seen_need_not_be_found(truth):
    visible = np.ones(SHAPE.corners, np.bool_)
    visible[:, :3] = False
    far = visible.copy()
    far[:, 3:5] = False
    status = np.where(far, Status.MEASURED, Status.MISSING).astype(np.uint8)
    score = score_grid(replace(truth, corner_status=status), truth, visible, far)
    assert (score.complete, score.complete_far) == (0, 1)
