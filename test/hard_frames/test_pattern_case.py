"""Frames of hand-made cases: exact truth, seeded, and what they say is visible."""

import numpy as np
import pytest

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.covers import COVERS, Cover
from hard_frames.studio import PatternCase, PatternStudio, pattern_rig


@pytest.fixture(scope="module")
def studio():
    return PatternStudio(samples=2)


@pytest.fixture(scope="module")
def rig():
    return pattern_rig(9, 14, corner_checker="light")


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
