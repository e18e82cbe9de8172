"""Frames of hand-made cases: exact truth, seeded, and what they say is visible."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from hard_frames.case import (
    COVERS,
    DEFORMATIONS,
    Cover,
    PatternCase,
    PatternStudio,
    Scenery,
    Zone,
    deform,
    deformation_of,
    degrade,
    pattern_rig,
)

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


def test_a_knock_moves_more_than_two_checkers(rig):
    moved = deform(rig, deformation_of("knock", rig.pattern)).corners() - rig.pattern.corners()
    middle = np.linalg.norm(moved[4, 7, :2])
    assert middle > 2 * rig.pattern.pitch


def test_the_seed_sets_the_frame(studio, rig):
    case = PatternCase(
        "all",
        rig,
        deformation_of("slide", rig.pattern, 1),
        CameraSettings(salt_and_pepper=0.01, clutter=3),
        PrintDefects(10, 5, ragged_edge=1e-5),
        scenery=Scenery(5, 2),
        cover=Cover("disc", texture=20.0),
    )
    image = studio.photograph(case).image
    np.testing.assert_array_equal(PatternStudio(samples=2).photograph(case).image, image)
    for other in (replace(case, seed=1), replace(case, frame=1)):
        assert (studio.photograph(other).image != image).any()


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


def test_a_frame_can_be_degraded_further(studio, rig):
    frame = studio.photograph(PatternCase("rest", rig))
    camera = CameraSettings(vignette=0.0, blur=3.0, read_noise=4.0)
    worse = degrade(frame, camera, Cover("left", 0.3))
    assert worse.visible["left"].sum() < frame.visible["left"].sum()
    assert worse.truth is frame.truth
    sharp, soft = (cv2.Laplacian(image, cv2.CV_64F)[:, 600:].std() for image in
                   (frame.image, cv2.GaussianBlur(worse.image, (0, 0), 1.5)))  # fmt: skip
    assert soft < sharp / 4


def test_zones_do_what_they_say():
    zone = Zone(x=1e-3, y=0.0, radius=2e-3, depth=5e-4, shift=(1e-4, 2e-4), turn=0.1)
    middle = zone.displacement(np.array([1e-3, 1.0]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(middle, [[1e-4, 2e-4, -5e-4], [0, 0, 0]], atol=1e-12)
    aside = Zone(radius=1.0, turn=0.1).displacement(np.array([1e-3]), np.array([0.0]))
    np.testing.assert_allclose(aside[0, :2], [np.cos(0.1) * 1e-3 - 1e-3, np.sin(0.1) * 1e-3], 1e-4)


def test_unknown_names_are_refused(rig):
    with pytest.raises(ParameterError, match=r"deformation: found 'fold'"):
        deformation_of("fold", rig.pattern)
    with pytest.raises(ParameterError, match=r"cover\.shape: found 'hole'"):
        Cover("hole")
