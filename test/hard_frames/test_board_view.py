"""Frames of a calibration board: geometry, greys, markers, poses."""

from dataclasses import replace

import numpy as np
import pytest
from board_photographs import photograph_board

from cmp_tactile_bringup.calibration import practice
from cmp_tactile_bringup.calibration.practice import bare_views, board_poses
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_simulation.rendering.camera import CameraSettings

CLEAR = CameraSettings(blur=0.0, vignette=0.0, read_noise=0.0)
BOARD = BoardTarget("chessboard", 6, 4, 1.6e-3)


def test_poses_lie_in_both_views_and_lean_to_all_sides(sensor):
    poses = board_poses(sensor, BOARD, 20, seed=3)
    for T in poses:
        for view in bare_views(sensor).values():
            q = view.project(BOARD.points @ T[:3, :3].T + T[:3, 3])
            assert (q > 0).all()
            assert (q < (view.placement.width - 1, view.placement.height - 1)).all()
    normals = np.array([T[:3, 2] for T in poses])
    assert np.degrees(np.arccos(normals[:, 2])).max() > 20
    assert normals[:, :2].min() < -0.2
    assert normals[:, :2].max() > 0.2
    again = board_poses(sensor, BOARD, 20, seed=3)
    np.testing.assert_array_equal(poses, again)
    with pytest.raises(CalibrationError, match="make the squares smaller"):
        board_poses(sensor, replace(BOARD, square=5e-3), 1)


def test_the_board_of_a_practice_set_is_the_same_seen_by_the_renderer(sensor):
    """Two ways to the same picture: rays that meet a plane, and a gel with the board's pattern."""
    for T in board_poses(sensor, BOARD, 2, seed=4):
        by_rays = photograph_board(sensor, BOARD, T, CLEAR).astype(float)
        rendered = practice.photograph_board(sensor, BOARD, T, CLEAR, 0).astype(float)
        off = np.abs(by_rays - rendered)
        # Greys differ at edges alone, by how they are sampled.
        assert np.percentile(off, 99) <= 12
        assert off.mean() < 0.5
