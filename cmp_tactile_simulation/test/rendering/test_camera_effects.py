"""Each knob of the camera, measured on a frame of which all else is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import DARK_GREY, LIGHT_GREY
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

HEIGHT, WIDTH = 120, 160
# A camera without any effect.
IDEAL = CameraSettings(blur=0.0, vignette=0.0, read_noise=0.0)
# Rounding to whole greys.
ROUNDING = 0.5


def _even(grey=LIGHT_GREY, fineness=2):
    shape = HEIGHT * fineness, WIDTH * fineness
    return RenderedFrame(np.full(shape, grey, dtype=np.float32), fineness)


def _edge(fineness=2):
    """Dark left of x = 80 - 0.5 px, light right of it."""
    frame = _even(fineness=fineness)
    frame.grey[:, : WIDTH * fineness // 2] = DARK_GREY
    return frame


def _expose(frame, seed=0, noise=0, **changes):
    settings = replace(IDEAL, **changes)
    return expose(frame, settings, np.random.default_rng(noise), seed).astype(np.float64)


def test_without_effects_the_frame_is_what_was_rendered():
    image = expose(_edge(), IDEAL, np.random.default_rng(0))
    assert image.dtype == np.uint8
    assert image.shape == (HEIGHT, WIDTH)
    assert (image[:, :80] == DARK_GREY).all()
    assert (image[:, 80:] == LIGHT_GREY).all()


@pytest.mark.parametrize(("fineness", "blur"), [(1, 1.5), (2, 0.7), (2, 2.0)])
def test_blur_has_the_deviation_asked_for(fineness, blur):
    image = _expose(_edge(fineness), blur=blur)
    # A deviation wrong by 4 % would differ by 1.5 greys beside the edge; greys are rounded.
    np.testing.assert_allclose(image[60], _blurred_edge(fineness, blur), atol=0.8)


def _blurred_edge(fineness, sigma):
    """Greys (WIDTH,) of the edge at x = 79.5 px, blurred, then averaged over each pixel's parts."""
    parts = (np.arange(WIDTH * fineness) + 0.5) / fineness - 0.5
    light = ndtr((parts - 79.5) / sigma).reshape(WIDTH, fineness).mean(axis=1)
    return DARK_GREY + (LIGHT_GREY - DARK_GREY) * light


@pytest.mark.parametrize(
    ("direction", "bright", "dark"),
    [(0.0, (60, 0), (60, -1)), (np.pi / 2, (0, 80), (-1, 80)), (-3 * np.pi / 4, (-1, -1), (0, 0))],
)
def test_light_fades_along_its_direction_by_its_ratio(direction, bright, dark):
    image = _expose(_even(), light_ratio=4.0, light_direction=direction)
    assert image[bright] == pytest.approx(LIGHT_GREY, abs=ROUNDING)
    assert image[dark] == pytest.approx(LIGHT_GREY / 4, abs=ROUNDING)
    assert image[60, 80] == pytest.approx(LIGHT_GREY * 0.625, rel=0.02)


def test_vignetting_takes_its_share_from_the_corners():
    image = _expose(_even(), vignette=0.4)
    assert image[0, 0] == image[-1, -1] == pytest.approx(LIGHT_GREY * 0.6, abs=ROUNDING)
    assert image[60, 80] == pytest.approx(LIGHT_GREY, abs=ROUNDING)
    # Half way to the corner a quarter of it is lost.
    assert image[30, 40] == pytest.approx(LIGHT_GREY * 0.9, rel=0.01)


def test_read_noise_has_its_deviation():
    image = _expose(_even(100.0), read_noise=3.0)
    # 19,200 pixels show a deviation to 0.5 %.
    assert image.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)
    assert image.mean() == pytest.approx(100, abs=0.1)


def test_salt_and_pepper_strike_their_share_half_white_half_black():
    image = _expose(_even(100.0), salt_and_pepper=0.1)
    white, black = np.mean(image == 255), np.mean(image == 0)
    # Binomial, 19,200 pixels: 0.05 +- 0.0016.
    assert white == pytest.approx(0.05, abs=0.006)
    assert black == pytest.approx(0.05, abs=0.006)
    assert np.mean(image == 100) == pytest.approx(1 - white - black, abs=1e-12)


def test_bright_light_saturates_and_does_not_wrap():
    image = _expose(_edge(), light_level=600.0, read_noise=2.0)
    assert (image[:, 82:] == 255).all()
    dark = _expose(_even(DARK_GREY), dark_level=0.0, read_noise=2.0)
    assert dark.max() < 20


def test_glare_and_clutter_stay_where_they_are():
    """They depend on the seed alone, not on the frame's own noise."""
    effects = {"glare_spots": 2, "clutter": 6, "read_noise": 0.5}
    first, second = (_expose(_even(100.0), noise=noise, **effects) for noise in (1, 2))
    assert (first != second).any()
    # Noise of 0.5 in both, rounded.
    assert np.abs(first - second).max() <= 5
    moved = _expose(_even(100.0), seed=9, **effects)
    assert np.abs(first - moved).max() > 30
