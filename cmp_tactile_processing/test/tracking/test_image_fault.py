"""Dark, white and empty images are distinguished from pictures in which a pattern might be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.tracking.image_fault import image_fault

SHAPE = (512, 594)


def _noisy(level, sigma, shape=SHAPE):
    noise = np.random.default_rng(3).normal(level, sigma, shape)
    return np.clip(np.rint(noise), 0, 255).astype(np.uint8)


def _checkers(side, dark, light, sigma):
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] // side
    return _noisy(0, sigma) + np.where((u + v) % 2, dark, light).astype(np.uint8)


@pytest.mark.parametrize(
    ("grey", "fault"),
    [
        (np.full(SHAPE, 9, np.uint8), GridFault.DARK),
        (_noisy(0, 16), GridFault.DARK),
        (_noisy(262, 8), GridFault.OVEREXPOSED),
        (np.full(SHAPE, 240, np.uint8), GridFault.OVEREXPOSED),
        (np.full(SHAPE, 30, np.uint8), GridFault.NO_CONTRAST),
        (_noisy(60, 4), GridFault.NO_CONTRAST),
        (_noisy(128, 30), GridFault.NO_CONTRAST),
        # Noise that a filter made alike in neighbours.
        (cv2.medianBlur(_noisy(120, 16), 3), GridFault.NO_CONTRAST),
    ],
)
def test_an_image_without_a_picture_is_named(grey, fault):
    found, reason = image_fault(grey)
    assert found is fault
    assert any(character.isdigit() for character in reason), "the reason says what was measured"


@pytest.mark.parametrize("ratio", [1.0, 0.35, 0.2, 0.1])
@pytest.mark.parametrize("name", ["rest", "press"])
def test_little_light_is_not_taken_for_none(stills, view_image, name, ratio):
    dimmed = np.rint(view_image(stills[name], "left") * ratio).astype(np.uint8)
    assert image_fault(dimmed) == (GridFault.NONE, "")


@pytest.mark.parametrize("side", [3, 4, 5, 7, 8, 9, 10, 11, 14, 17, 22, 35, 60, 77])
@pytest.mark.parametrize(("dark", "light", "sigma"), [(40, 70, 1.0), (10, 34, 1.0), (20, 60, 16.0)])
def test_checkers_of_any_size_have_contrast(side, dark, light, sigma):
    """Pixels that are looked at in step with the checkers would meet one colour only."""
    assert image_fault(_checkers(side, dark, light, sigma))[0] is GridFault.NONE


def test_glare_over_half_of_the_pattern_is_not_overexposure(stills, view_image):
    grey = view_image(stills["rest"], "left").copy()
    grey[:, : grey.shape[1] // 2] = 255
    assert image_fault(grey)[0] is GridFault.NONE
    grey[:, : int(0.95 * grey.shape[1])] = 255
    assert image_fault(grey)[0] is GridFault.OVEREXPOSED


def test_no_pixels_are_an_error():
    with pytest.raises(FrameError, match=r"image: found shape \(0, 7\), expected pixels"):
        image_fault(np.zeros((0, 7), np.uint8))
