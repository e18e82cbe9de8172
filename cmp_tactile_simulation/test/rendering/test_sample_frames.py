"""Agreement with frames of an independent renderer of the same rig."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import DARK_GREY, HOUSING_GREY, LIGHT_GREY, Checkerboard
from cmp_tactile_simulation.rendering.renderer import Renderer, true_grids
from cmp_tactile_simulation.rendering.surface import DeformedSurface

DATA = Path(__file__).parents[1] / "data"
# Noise of sigma 1 and the rounding of two frames to whole greys.
NOISE = np.sqrt(1 + 2 / 12)
# The sample frame was blurred by sigma 0.7 px and darkened by 0.15 in its corners.
QUIET = CameraSettings(blur=0.7, vignette=0.15, read_noise=0.0)


@pytest.fixture(scope="module")
def theirs():
    return cv2.imread(str(DATA / "rest.png"), cv2.IMREAD_GRAYSCALE)


@pytest.fixture(scope="module")
def truth():
    """Arrays of the truth of their frame at rest."""
    with np.load(DATA / "rest.npz", allow_pickle=False) as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def rendered(sensor):
    return Renderer(sensor, Checkerboard(sensor.pattern)).render(
        DeformedSurface.rest(sensor.pattern)
    )


def test_true_grids_agree_with_their_truth(sensor, truth):
    grids = true_grids(sensor, DeformedSurface.rest(sensor.pattern))
    number = np.arange(19)[:, None] * 7 + np.arange(1, 7)
    for side, grid in grids.items():
        np.testing.assert_allclose(grid.corners_frame, truth[f"corners_{side}_px"], atol=1e-6)
    left = grids["left"]
    rows, cols = truth["row_lines_left_px"], truth["col_lines_left_px"]
    # Their virtual markers are single precision.
    np.testing.assert_allclose(left.row_lines_frame, rows[:, number], atol=1e-4)
    np.testing.assert_allclose(
        left.col_lines_frame, cols[:, number].transpose(1, 0, 2, 3), atol=1e-4
    )


def test_the_undeformed_frame_agrees_to_the_camera_noise(theirs, rendered):
    ours = expose(rendered, QUIET, np.random.default_rng(0))
    off = theirs.astype(np.float64) - ours
    for region, mask in _regions(rendered.pixels).items():
        assert np.count_nonzero(mask) > 50_000, region
        assert abs(off[mask].mean()) < 0.05, region
        # 50,000 pixels show the deviation to 0.3 %.
        assert off[mask].std() == pytest.approx(NOISE, rel=0.02), region


def _regions(grey):
    """Parts of the frame away from the housing's edge and the seam between the views."""
    skin = cv2.erode((grey != HOUSING_GREY).astype(np.uint8), np.ones((13, 13))) > 0
    skin[:6], skin[-6:], skin[:, :6], skin[:, -6:], skin[:, 506:518] = (False,) * 5
    mixed = ((grey > DARK_GREY + 0.5) & (grey < LIGHT_GREY - 0.5)).astype(np.uint8)
    edges = cv2.dilate(mixed, np.ones((5, 5))) > 0
    dark = grey < (DARK_GREY + LIGHT_GREY) / 2
    return {
        "edges": skin & edges,
        "dark ink": skin & ~edges & dark,
        "light skin": skin & ~edges & ~dark,
        "housing": cv2.erode((grey == HOUSING_GREY).astype(np.uint8), np.ones((13, 13))) > 0,
    }
