"""Boards: what may be asked for, in which order corners are counted, and where they are found."""

import cv2
import numpy as np
import pytest
from board_photographs import photograph_board
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.calibration.practice import bare_views, board_poses
from cmp_tactile_processing.calibration.board.target import BoardTarget, find_board
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.split import split_frame
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


@pytest.mark.parametrize("rows", [6, 7])
def test_a_charuco_board_of_either_layout_is_found(rows):
    """Reports: opencv/opencv 23152 and 29636, opencv/opencv_contrib 3291; tried: not found."""
    target = BoardTarget("charuco", 9, rows, 1.2e-3, 0.9e-3, "DICT_4X4_50")
    board = target.charuco_board()
    seen = []
    for is_legacy in (False, True):
        board.setLegacyPattern(is_legacy)
        drawn = board.generateImage((10 * 60, (rows + 1) * 60), marginSize=0)
        seen.append(find_board(np.pad(drawn, 60, constant_values=255), target))
    assert [len(item.number) for item in seen] == [target.count] * 2
    np.testing.assert_allclose(seen[1].pixels, seen[0].pixels, atol=0.05)


def test_one_line_of_corners_is_no_board(charuco):
    """It defines no plane: OpenCV's calibration would fail on it."""
    picture = np.pad(charuco.picture(60), 60, constant_values=255)
    two_lines = find_board(picture[: 60 * 4], charuco)
    assert two_lines is not None
    assert set(two_lines.number // charuco.cols) == {0, 1}
    assert find_board(picture[: 60 * 3], charuco) is None


LARGE = (1944, 2592)


def _without_board(kind: str) -> np.ndarray:
    rng = np.random.default_rng(3)
    if kind == "noise":
        return rng.integers(0, 256, LARGE, np.uint8)
    return np.clip(rng.normal(2.0, 1.5, LARGE), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", ["noise", "dark"])
def test_large_images_without_a_board_have_none(kind, monkeypatch):
    """OpenCV's older search takes minutes for them: it is only asked about a reduced image.

    - opencv/opencv 23558 (26 x 16 corners in an almost black image: "running endlessly"), 24558
      (its fast check passes the image on by chance, 15 minutes): 1 s, no board.
    - ElvinC/gyroflow 116 (minutes for each frame without the board): as above.
    - ros-perception/image_pipeline 589 (boards are lost in a reduced image): the newer search
      still has the whole image, see the test of small squares.
    """
    sizes: list[int] = []
    search = cv2.findChessboardCorners

    def counted(image, *given, **more):
        sizes.append(image.size)
        return search(image, *given, **more)

    monkeypatch.setattr(cv2, "findChessboardCorners", counted)
    assert find_board(_without_board(kind), BoardTarget("chessboard", 26, 16, 0.01)) is None
    assert max(sizes) <= 1000 * 1000


@pytest.mark.parametrize(
    ("square_px", "blur_px", "tolerance_px"), [(150, 15.0, 1.0), (150, 3.0, 0.2), (14, 1.0, 0.2)]
)
def test_boards_in_large_images_are_where_they_were_put(square_px, blur_px, tolerance_px):
    """Blurred by 15 px only the older search finds it; squares of 14 px only the newer one."""
    target = BoardTarget("chessboard", 7, 4, 1.6e-3)
    H = np.array([[1.0, 0.15, 300.0], [-0.1, 0.95, 500.0], [1e-5, 2e-5, 1.0]])
    size = LARGE[::-1]
    sharp = cv2.warpPerspective(target.picture(square_px), H, size, borderValue=230)
    noise = np.random.default_rng(4).normal(0, 2, LARGE)
    image = 40 + 0.3 * cv2.GaussianBlur(sharp, (0, 0), blur_px).astype(float) + noise
    found = find_board(np.clip(image, 0, 255).astype(np.uint8), target)
    assert found is not None
    i, j = np.divmod(found.number, target.cols)
    # Between the pixels of its picture; symmetric under half a turn or not, corners are the same.
    p = np.stack([(j + 1) * square_px - 0.5, (i + 1) * square_px - 0.5, np.ones(len(i))])
    q = H @ p
    expected = (q[:2] / q[2]).T
    distance = np.linalg.norm(found.pixels[:, None] - expected[None], axis=-1).min(axis=1)
    # Windows of corners near the border reach beyond the board where it is blurred.
    assert len(found.number) >= 0.8 * target.count
    assert distance.max() < tolerance_px
