"""Frames of hand-made cases: exact truth, seeded, and what they say is visible."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.covers import COVERS, Cover
from hard_frames.deformation import DEFORMATIONS, deformation_of
from hard_frames.studio import PatternCase, PatternStudio, pattern_rig

# cornerSubPix on a frame with blur 0.7 px and noise 1: its own error, from the true places.
SUBPIX_RMSE_PX = 0.05


@pytest.fixture(scope="module")
def studio():
    return PatternStudio(samples=2)


@pytest.fixture(scope="module")
def rig():
    return pattern_rig(9, 14, corner_checker="light")


def refined(frame, view):
    truth = frame.truth[view]
    image = split_frame(frame.image, truth.placement)
    start = truth.corners.reshape(-1, 1, 2).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3)
    return cv2.cornerSubPix(image, start, (5, 5), (-1, -1), stop).reshape(truth.corners.shape)


@pytest.mark.parametrize("kind", DEFORMATIONS)
def test_the_truth_is_where_the_image_shows_corners(studio, rig, kind):
    case = PatternCase(kind, rig, deformation_of(kind, rig.pattern))
    frame = studio.photograph(case)
    for view, truth in frame.truth.items():
        error = refined(frame, view) - truth.corners
        assert np.sqrt((error**2).sum(-1).mean()) < SUBPIX_RMSE_PX
        assert frame.visible[view].all()


@pytest.mark.parametrize("shape", COVERS)
def test_covered_corners_are_not_visible_and_their_pixels_are_the_covers(studio, rig, shape):
    plain = CameraSettings(vignette=0.0, blur=0.0, read_noise=0.0)
    case = PatternCase("covered", rig, (), plain, cover=Cover(shape, 0.3, 111.0))
    frame = studio.photograph(case)
    for view, truth in frame.truth.items():
        image = split_frame(frame.image, truth.placement)
        x, y = np.rint(truth.corners).astype(int).transpose(2, 0, 1)
        visible, far = frame.visible[view], frame.far[view]
        assert ((image[y, x] == 111) == ~visible).mean() > 0.97
        assert 0 < far.sum() < visible.sum() < visible.size
        assert not (far & ~visible).any()


def test_what_no_light_shows_is_not_visible(studio, rig):
    dark = CameraSettings(light_level=2.0, dark_level=1.0)
    frame = studio.photograph(PatternCase("dark", rig, camera=dark))
    assert not any(visible.any() for visible in frame.visible.values())
    glare = CameraSettings(glare_spots=60, glare_size=12.0, glare_strength=3000.0)
    frame = studio.photograph(PatternCase("glare", rig, camera=glare))
    assert all(0 < visible.mean() < 1 for visible in frame.visible.values())
