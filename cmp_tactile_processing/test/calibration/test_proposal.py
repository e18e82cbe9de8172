"""From one picture a description is made that finds its pattern again."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.calibration.proposal import lattice_step, propose
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.optics import build_views

PITCH_M = 0.002
# Pixels of the drawing for a checker's side.
FINE = 20


def board(rows, cols, side, *, angle=0.0, tilt=(0.0, 0.0), dark=True, size=(640, 480)):
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
    noise = np.random.default_rng(rows).normal(0, 3, seen.shape)
    soft = cv2.GaussianBlur(seen, (0, 0), 0.8)
    return np.clip(np.rint(soft + noise), 0, 255).astype(np.uint8)


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
    found = propose(image, PITCH_M, "mine")
    pattern = found.sensor.pattern
    assert (pattern.rows, pattern.cols, pattern.border) == (rows, cols, "in_view")
    assert pattern.corner_checker == ("dark" if more.get("dark", True) else "light")
    assert found.grid.found_fraction == 1
    view = build_views(found.sensor)["left"]
    # A plane seen by a camera of some focal length: a few pixels, where it is tilted.
    off = np.linalg.norm(view.project(pattern.corners()) - found.grid.corners, axis=-1)
    assert np.median(off) < 0.15 * side


def test_a_pattern_that_goes_on_beyond_the_picture_is_described_so():
    found = propose(board(60, 60, 16.0), PITCH_M, "mine")
    pattern = found.sensor.pattern
    assert pattern.border == "beyond_view"
    assert (pattern.rows, pattern.cols) >= (24, 34)
    assert found.grid.found_fraction == 1


def test_the_picture_is_judged():
    sharp = propose(board(12, 16, 20.0), PITCH_M, "mine")
    image = cv2.GaussianBlur(board(12, 16, 20.0), (0, 0), 4.0)
    soft = propose(image, PITCH_M, "mine")
    assert sharp.side_px == pytest.approx(20.0, rel=0.01)
    assert sharp.contrast == pytest.approx(160, abs=15)
    assert sharp.noise == pytest.approx(3.0, rel=0.2)
    assert soft.sharpness < 0.8 < sharp.sharpness
    # In the plane a pixel is as large as the pitch over the side.
    assert sharp.std_m == pytest.approx(
        np.nanmedian(sharp.grid.corner_std) * PITCH_M / 20.0, rel=0.02
    )


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
        propose(image, PITCH_M, "mine")
