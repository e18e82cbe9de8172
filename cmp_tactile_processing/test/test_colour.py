"""Colour frames become grey by luminance, or by a projection that distinguishes two colours."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmp_tactile_processing import GridTracker
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.split import LUMINANCE, to_grey
from cmp_tactile_processing.measured import GridFault
from cmp_tactile_processing.sensor.parameters import TrackingParameters
from cmp_tactile_processing.tracking.image_fault import image_fault

# Red and green that look alike in grey.
RED, GREEN = 200.0, 200.0 * LUMINANCE[0] / LUMINANCE[1]
RED_AGAINST_GREEN = TrackingParameters(red=0.5, green=-0.5, blue=0.0)
# As for grey frames: what rounding to 8 bits in two colours adds is small against it.
RMSE_PX = 0.05


def _red_and_green(grey: np.ndarray) -> np.ndarray:
    """BGR image whose dark pixels are green and whose light ones are red, equal in luminance."""
    share = np.clip((grey.astype(float) - 15) / 190, 0, 1)
    colours = np.stack([np.zeros_like(share), GREEN * (1 - share), RED * share], axis=-1)
    return np.rint(colours).astype(np.uint8)


def _every_colour() -> np.ndarray:
    levels = np.arange(0, 256, 15, dtype=np.uint8)
    return np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, len(levels), 3)


def test_the_default_is_the_luminance():
    image = _every_colour()
    expected = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(to_grey(image), expected)
    nearly = (LUMINANCE[0] + 1e-9, *LUMINANCE[1:])
    assert np.abs(to_grey(image, nearly).astype(int) - expected).max() <= 1


@pytest.mark.parametrize(
    "weights", [(1.0, 0.0, 0.0), (0.5, -0.5, 0.0), (-1.0, 0.25, 0.25), (0.001, 0.0, -0.002)]
)
def test_every_projection_uses_the_whole_range_and_no_more(weights):
    """Scaled by the range of all colours: saturation would hide the difference of two colours."""
    image = _every_colour()
    projected = image[..., ::-1].astype(float) @ np.array(weights)
    expected = 255 * (projected - projected.min()) / np.ptp(projected)
    found = to_grey(image, weights)
    assert np.abs(found - expected).max() <= 0.5 + 1e-6
    assert (found.min(), found.max()) == (0, 255)


@pytest.mark.parametrize("weights", [(0.0, 0.0, 0.0), (math.nan, 1.0, 0.0), (math.inf, 0.0, 0.0)])
def test_weights_that_tell_nothing_apart_are_named(weights):
    with pytest.raises(InputError, match=r"tracking\.red, tracking\.green, tracking\.blue: "):
        to_grey(np.zeros((4, 4, 3), np.uint8), weights)
    with pytest.raises(InputError, match=r"tracking\.red.*: found .*, expected "):
        TrackingParameters(red=weights[0], green=weights[1], blue=weights[2])


def test_a_pattern_that_grey_cannot_see_is_tracked_in_its_colours(sensor, stills, view_image):
    still = stills["press"]
    image = _red_and_green(view_image(still, "left"))
    assert image_fault(to_grey(image))[0] is GridFault.NO_CONTRAST
    assert GridTracker(sensor, "left").track(image).found_fraction == 0
    coloured = replace(sensor, tracking=RED_AGAINST_GREEN)
    grid = GridTracker(coloured, "left").track(image)
    assert grid.found_fraction == 1
    error = grid.corners_frame - still.truth["corners_left_px"]
    assert np.sqrt(np.mean(np.sum(error**2, axis=-1))) < RMSE_PX
