"""Frames of a calibration board: geometry, greys, markers, poses."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_photographs import photograph_board

from cmp_tactile_bringup.calibration import practice_rig
from cmp_tactile_bringup.calibration.practice_rig import bare_views, board_poses
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.sensor.parts import RefractingLayer
from cmp_tactile_simulation.rendering.camera import CameraSettings

CLEAR = CameraSettings(blur=0.0, vignette=0.0, read_noise=0.0)
BOARD = BoardTarget("chessboard", 6, 4, 1.6e-3)


def _facing(sensor):
    """The board about the gel's middle, its front towards the camera below."""
    T = np.eye(4)
    T[:3, 3] = -BOARD.points.mean(axis=0)
    return T


@pytest.fixture(scope="module")
def frame(sensor):
    return photograph_board(sensor, BOARD, _facing(sensor), CLEAR)


def test_squares_have_the_greys_of_the_board_in_both_views(sensor, frame):
    """Fails where a view shows the board mirrored, shifted or from another pose."""
    T = _facing(sensor)
    for view in bare_views(sensor).values():
        for i in range(-1, BOARD.rows):
            for j in range(-1, BOARD.cols):
                centre = T[:3, 3] + BOARD.square * np.array([j + 0.5, i + 0.5, 0.0])
                x, y = view.placement.to_frame(view.project(centre)).round().astype(int)
                assert abs(int(frame[y, x]) - (45 if (i + j) % 2 == 0 else 205)) <= 1
        paper = T[:3, 3] - 1.5 * BOARD.square * np.array([1.0, 1.0, 0.0])
        x, y = view.placement.to_frame(view.project(paper)).round().astype(int)
        assert frame[y, x] == 205


def test_edges_are_antialiased_without_a_shift(sensor, frame):
    """The sum of grey along a line across an edge shows where the edge is."""
    T, view = _facing(sensor), bare_views(sensor)["left"]
    image = frame[:, :512][:, ::-1]
    start, end = (
        view.project(T[:3, 3] + BOARD.square * np.array([x, 0.5, 0.0])) for x in (0.6, 1.4)
    )
    share = np.linspace(0, 1, 2001)[:, None]
    line = (start + share * (end - start)).astype(np.float32)
    greys = cv2.remap(image, line[None, :, 0], line[None, :, 1], cv2.INTER_LINEAR).ravel()
    step = np.sign(float(greys[-1]) - float(greys[0]))
    dark = np.mean((greys.astype(float) - 45) / 160)
    edge = start + (dark if step < 0 else 1 - dark) * (end - start)
    true = view.project(T[:3, 3] + BOARD.square * np.array([1.0, 0.5, 0.0]))
    # Rounding to grey levels and bilinear interpolation of the check itself.
    np.testing.assert_allclose(edge, true, atol=0.03)


def test_the_back_of_the_board_is_blank(sensor):
    T = _facing(sensor)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] *= (1, -1, 1)
    frame = photograph_board(sensor, BOARD, T, CLEAR)
    assert frame.max() < 45


def test_a_lens_that_does_not_reach_the_corners_of_the_frame(sensor):
    """Pixels beyond the field of a strongly distorting lens must not take the others with them."""
    bent = replace(sensor.camera, distortion=(-0.45, 0.0, 0.0, 0.0, 0.0))
    rig = replace(sensor, camera=bent)
    view = bare_views(rig)["left"]
    assert np.isnan(view.rays(np.array([[511.0, 767.0], [0.0, 0.0]]))[1]).any()
    dim = photograph_board(rig, BOARD, _facing(sensor), CLEAR)
    for j, grey in ((0.5, 45), (1.5, 205)):
        centre = _facing(sensor)[:3, 3] + BOARD.square * np.array([j, 0.5, 0.0])
        x, y = view.placement.to_frame(view.project(centre)).round().astype(int)
        assert dim[y, x] == grey


def test_layers_are_gone_with_the_gel(sensor, frame):
    layers = (RefractingLayer(-0.01, 1.49), RefractingLayer(-0.006, 1.41))
    plated = replace(sensor, optics=replace(sensor.optics, layers=layers))
    np.testing.assert_array_equal(photograph_board(plated, BOARD, _facing(sensor), CLEAR), frame)


def test_noise_is_that_of_the_seed(sensor):
    noisy = CameraSettings(read_noise=4.0)
    frames = [photograph_board(sensor, BOARD, _facing(sensor), noisy, seed) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(frames[0], frames[1])
    difference = (frames[1].astype(float) - frames[2]).std()
    assert difference == pytest.approx(4.0 * 2**0.5, rel=0.1)


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
    with pytest.raises(CalibrationError, match="expected smaller squares"):
        board_poses(sensor, replace(BOARD, square=5e-3), 1)


def test_the_board_of_a_practice_set_is_the_same_seen_by_the_renderer(sensor):
    """Two ways to the same picture: rays that meet a plane, and a gel with the board's pattern."""
    for T in board_poses(sensor, BOARD, 2, seed=4):
        by_rays = photograph_board(sensor, BOARD, T, CLEAR).astype(float)
        rendered = practice_rig.photograph_board(sensor, BOARD, T, CLEAR, 0).astype(float)
        off = np.abs(by_rays - rendered)
        # Greys differ at edges alone, by how they are sampled.
        assert np.percentile(off, 99) <= 12
        assert off.mean() < 0.5
