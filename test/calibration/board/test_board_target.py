"""Boards: what may be asked for, in which order corners are counted, and where they are found."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_simulation.hard_frames.changed_rig import bare_views, board_poses, photograph_board
from cmp_tactile_simulation.rendering.camera import CameraSettings

# Measured at noise 4, squares of 17 to 30 px: 0.016 px per coordinate on chessboards, 0.022
# where the markers leave a smaller window.
ATOL_CHESSBOARD_PX, ATOL_CHARUCO_PX = 0.03, 0.04


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (("checkers", 9, 6, 0.01), "kind: found checkers, expected chessboard or charuco"),
        (("chessboard", 2, 6, 0.01), "cols: found 2, expected 3 to 60"),
        (("chessboard", 9, 99, 0.01), "rows: found 99"),
        (("chessboard", 9, 6, 0.0), "square: found 0.0, expected a length in m above 0"),
        (("charuco", 9, 6, 0.01, 0.01), "marker: found 0.01"),
        (("charuco", 9, 6, 0.01, 0.007, "DICT_9X9"), "dictionary: found DICT_9X9"),
        (("charuco", 19, 16, 0.01, 0.007, "DICT_4X4_50"), "at least 170 markers"),
    ],
)
def test_a_board_that_cannot_be_is_refused(values, match):
    with pytest.raises(CalibrationError, match=match):
        BoardTarget(*values)


@pytest.mark.parametrize(
    ("cols", "rows", "orders"), [(9, 6, 1), (8, 6, 2), (9, 7, 2), (6, 6, 4), (7, 7, 2)]
)
def test_symmetries_are_the_turns_under_which_the_picture_stays(cols, rows, orders):
    target = BoardTarget("chessboard", cols, rows, 1.0)
    assert len(target.symmetries) == orders
    picture = target.picture(1)
    numbers = np.arange(target.count).reshape(rows, cols)
    same = [
        np.rot90(numbers, turn).ravel().tolist()
        for turn in range(4)
        if np.array_equal(np.rot90(picture, turn), picture)
    ]
    assert [order.tolist() for order in target.symmetries] == same


@pytest.mark.parametrize("kind", ["full_chessboard", "charuco"])
def test_corners_are_found_where_the_optics_put_them(request, full_built, kind):
    """Mirrored views, distortion: fails where an image is not un-mirrored or a number is wrong."""
    built, target = full_built, request.getfixturevalue(kind)
    tolerance = ATOL_CHESSBOARD_PX if kind == "full_chessboard" else ATOL_CHARUCO_PX
    for k, T in enumerate(board_poses(built, target, 2, seed=2)):
        frame = photograph_board(built, target, T, CameraSettings(read_noise=4.0), seed=k)
        for name, view in bare_views(built).items():
            found = find_board(split_frame(frame, view.placement), target, name)
            assert found is not None
            assert len(found.number) > 0.9 * target.count
            q = view.project(target.points @ T[:3, :3].T + T[:3, 3])
            error = found.pixels - q[found.number]
            assert np.sqrt((error**2).mean()) < tolerance
            # The standard deviation that is reported must be about that of the error.
            assert 0.5 < np.sqrt((error**2).mean()) / np.sqrt((found.std**2).mean()) < 2


def test_both_views_count_a_board_from_the_same_end(built, chessboard):
    """Turned by half a turn the board looks different, and corner 0 goes with it."""
    (T,) = board_poses(built, chessboard, 1, seed=3)
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", np.pi).as_matrix()
    turned[:3, 3] += T[:3, :3] @ chessboard.points[-1]
    for pose in (T, turned):
        frame = photograph_board(built, chessboard, pose)
        for view in bare_views(built).values():
            found = find_board(split_frame(frame, view.placement), chessboard)
            q = view.project(pose[:3, 3])
            assert found is not None
            np.testing.assert_allclose(found.pixels[found.number == 0][0], q, atol=0.2)


def test_one_line_of_corners_is_no_board(charuco):
    """It defines no plane: OpenCV's calibration would fail on it."""
    picture = np.pad(charuco.picture(60), 60, constant_values=255)
    two_lines = find_board(picture[: 60 * 4], charuco)
    assert two_lines is not None
    assert set(two_lines.number // charuco.cols) == {0, 1}
    assert find_board(picture[: 60 * 3], charuco) is None
