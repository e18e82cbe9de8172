"""From one picture a description is made that finds its pattern again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.calibration.counting import GOOD, count_corners, lattice_step
from cmp_tactile_processing.calibration.proposal import Known, mirrors_of, propose
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import load_sensor

PITCH_M = 0.002
KNOWN = Known(PITCH_M)
# Pixels of the drawing for a checker's side.
FINE = 20


def board(
    rows,
    cols,
    side,
    *,
    angle=0.0,
    tilt=(0.0, 0.0),
    dark=True,
    size=(640, 480),
    noise=3.0,
    soft=0.8,
):
    """A picture of a board with rows x cols corners on a plain margin, noisy and a little soft.

    side: px; angle: degrees; tilt: change of the scale over a pixel along x and y.
    """
    margin = 200 if dark else 40
    checkers = np.where((np.indices((rows + 1, cols + 1)).sum(axis=0) % 2 == 0) == dark, 40, 200)
    drawn = np.kron(checkers, np.ones((FINE, FINE))).astype(np.uint8)
    drawn = cv2.copyMakeBorder(drawn, *(3 * FINE,) * 4, cv2.BORDER_CONSTANT, value=margin)
    (height, width), (right, down) = drawn.shape, size
    place = cv2.getRotationMatrix2D((width / 2, height / 2), -angle, side / FINE)
    place[:, 2] += (right - width) / 2, (down - height) / 2
    tilted = np.array([[1, 0, 0], [0, 1, 0], [*tilt, 1 - tilt[0] * right / 2 - tilt[1] * down / 2]])
    whole = tilted @ np.vstack([place, [0, 0, 1]])
    seen = cv2.warpPerspective(drawn, whole, size, flags=cv2.INTER_AREA, borderValue=margin)
    if soft:
        seen = cv2.GaussianBlur(seen, (0, 0), soft)
    off = np.random.default_rng(rows).normal(0, noise, seen.shape)
    return np.clip(np.rint(seen + off), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("rows", "cols", "side", "more"),
    [
        (12, 16, 20.0, {}),
        (8, 13, 13.0, {"angle": 12.0, "dark": False}),
        (20, 20, 16.0, {"angle": -20.0}),
        (9, 17, 24.0, {"tilt": (3e-4, -2e-4)}),
    ],
)
def test_corners_are_counted_and_found_again(rows, cols, side, more):
    image = board(rows, cols, side, **more)
    found = propose(image, KNOWN, "mine", "one")
    pattern = found.sensor.pattern
    assert (pattern.rows, pattern.cols, pattern.border) == (rows, cols, "in_view")
    assert pattern.corner_checker == ("dark" if more.get("dark", True) else "light")
    assert found.layout == "one"
    assert found.grids["left"].found_fraction == 1
    view = build_views(found.sensor)["left"]
    # A plane seen by a camera of some focal length: a few pixels, where it is tilted.
    off = np.linalg.norm(view.project(pattern.corners()) - found.grids["left"].corners, axis=-1)
    assert np.median(off) < 0.15 * side


def test_a_pattern_that_goes_on_beyond_the_picture_is_described_so():
    found = propose(board(60, 60, 16.0), KNOWN, "mine", "one")
    pattern = found.sensor.pattern
    assert pattern.border == "beyond_view"
    assert (pattern.rows, pattern.cols) >= (24, 34)
    assert found.grids["left"].found_fraction == 1


def test_a_picture_of_many_pixels_is_looked_at_whole():
    found = propose(board(12, 16, 60.0, size=(1920, 1440)), KNOWN, "mine", "one")
    assert (found.sensor.pattern.rows, found.sensor.pattern.cols) == (12, 16)


def test_more_corners_than_a_description_can_have_with_a_border_go_on_beyond_it():
    found = propose(board(64, 64, 11.0, size=(800, 800)), KNOWN, "mine", "one")
    assert found.sensor.pattern.border == "beyond_view"


def test_too_few_lines_are_named():
    with pytest.raises(FrameError, match=r"picture: found 5 x 16 corners, expected at least 6"):
        propose(board(5, 16, 20.0), KNOWN, "mine", "one")


# Blur is found to this, px, or to this share; noise and contrast to these shares.
BLUR_TOLERANCE_PX, BLUR_TOLERANCE = 0.08, 0.05
NOISE_TOLERANCE, CONTRAST_TOLERANCE = 0.15, 0.05
# A standard deviation that one change leaves is predicted to this share.
STD_TOLERANCE = 0.25
# A picture is drawn with so many points of a pixel along a side.
POINTS = 4


def photograph(sigma, *, side=20.0, contrast=160, noise=1.0):
    """A board with checkers of a known side and blur, px, integrated over the pixels."""
    width, height = 640 * POINTS, 480 * POINTS
    fine = board(12, 16, side * POINTS, angle=4.0, size=(width, height), noise=0.0, soft=0.0)
    lens = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), sigma * POINTS)
    grey = 120 + contrast / 160 * (cv2.resize(lens, (640, 480), interpolation=cv2.INTER_AREA) - 120)
    grey += np.random.default_rng(2).normal(0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma", [0.6, 1.0, 1.5, 3.0])
@pytest.mark.parametrize(("contrast", "noise"), [(160, 1.0), (80, 1.0), (160, 6.0)])
def test_blur_contrast_and_noise_of_a_picture_are_measured_one_by_one(sigma, contrast, noise):
    worth = count_corners(photograph(sigma, contrast=contrast, noise=noise)).quality
    tolerance = max(BLUR_TOLERANCE_PX, BLUR_TOLERANCE * sigma)
    assert worth.blur_px == pytest.approx(sigma, abs=tolerance)
    assert worth.contrast == pytest.approx(contrast, rel=CONTRAST_TOLERANCE)
    assert worth.noise == pytest.approx(noise, rel=NOISE_TOLERANCE)
    assert worth.side_px == pytest.approx(20.0, rel=0.01)
    assert worth.saturated == 0


@pytest.mark.parametrize(
    ("name", "bad"),
    [("blur_px", {"sigma": 3.0}), ("contrast", {"contrast": 40}), ("noise", {"noise": 8.0})],
)
def test_what_one_change_would_gain_is_what_it_gains(name, bad):
    usual = {"sigma": GOOD.blur_px, "contrast": GOOD.contrast, "noise": GOOD.noise}
    worth = count_corners(photograph(**{**usual, **bad})).quality
    good = count_corners(photograph(**usual)).quality
    assert worth.std_if(name) == pytest.approx(good.std_pitch, rel=STD_TOLERANCE)
    assert worth.std_pitch > 2 * good.std_pitch
    others = {"blur_px", "contrast", "noise", "side_px"} - {name}
    assert all(worth.std_if(other) > worth.std_if(name) for other in others)
    assert len(worth.advice(0.5)) == 1
    assert not good.advice(0.3)


def test_overexposed_checkers_come_first():
    image = board(12, 16, 20.0, dark=False)
    worth = count_corners(np.clip(image.astype(int) * 2, 0, 255).astype(np.uint8)).quality
    assert worth.saturated == pytest.approx(1.0, abs=0.05)
    assert "reduce the light" in worth.advice(0.5)[0]


def test_mirrors_are_found_from_what_they_show():
    sensor = load_sensor("sample_rig")
    left, right = (view.T_view_gel for view in build_views(sensor).values())
    pose, mirrors = mirrors_of(left, right)
    np.testing.assert_allclose(pose, sensor.optics.T_camera_gel, atol=1e-9)
    for mirror, view in zip(mirrors, sensor.views.values(), strict=True):
        np.testing.assert_allclose(mirror.normal, view.mirror.normal, atol=1e-9)
        assert mirror.distance == pytest.approx(view.mirror.distance, abs=1e-9)


def test_views_that_no_two_mirrors_show_are_named():
    left = build_views(load_sensor("sample_rig"))["left"].T_view_gel
    with pytest.raises(FrameError, match=r"rotation of 0\.0 degrees"):
        mirrors_of(left, left)


def test_the_side_of_the_checkers_is_read_from_the_spectrum():
    step = lattice_step(board(12, 16, 20.0, angle=10.0))
    assert np.linalg.norm(step) == pytest.approx(20.0, rel=0.05)
    assert np.degrees(np.arctan2(step[1], step[0])) == pytest.approx(10.0, abs=2.0)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((480, 640), np.uint8),
        np.random.default_rng(1).integers(0, 255, (480, 640)).astype(np.uint8),
        np.tile((np.arange(640) // 10 % 2 * 150 + 50).astype(np.uint8), (480, 1)),
    ],
    ids=["black", "noise", "stripes"],
)
def test_what_shows_no_checkers_is_refused(image):
    with pytest.raises(FrameError, match=r"picture: found .* expected"):
        propose(image, KNOWN, "mine")


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_sighting_is_turned_as_its_picture(quarters):
    image = board(9, 12, 20.0, angle=2.0, dark=False)
    expected, found = count_corners(np.rot90(image, quarters).copy()), count_corners(image)
    found = found.turned(quarters)
    assert (found.even, found.ends) == (expected.even, expected.ends)
    assert found.corners.shape == expected.corners.shape
    seen = found.corners[0, 0]
    for _ in range(quarters):
        # The picture is turned about its middle.
        seen = np.array([seen[1], image.shape[1] - 1 - seen[0]])
        image = np.rot90(image)
    np.testing.assert_allclose(seen, expected.corners[0, 0], atol=1.0)
