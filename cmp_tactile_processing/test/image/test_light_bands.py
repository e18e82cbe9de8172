"""Bands of light are found by what they take from rows, and taken out again."""

import numpy as np
import pytest

from cmp_tactile_processing.image.light_bands import LightBands

HEIGHT, WIDTH, SIDE = 480, 400, 16
# Of a row's level, and of what is left of bands, in grey levels.
LOSS_TOLERANCE, LEVEL_TOLERANCE = 0.03, 2.5


def checkers(light=1.0, shift=0, noise=1.0, seed=0):
    """Checkers in a margin, their light by row (H,), rows moved by `shift` px."""
    y, x = np.indices((HEIGHT, WIDTH))
    inside = (abs(y - shift - HEIGHT / 2) < 200) & (abs(x - WIDTH / 2) < 160)
    dark = inside & (((y - shift) // SIDE + x // SIDE) % 2 == 0)
    grey = np.where(dark, 45.0, 205.0) * np.broadcast_to(light, (HEIGHT,))[:, None]
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.rint(grey).clip(0, 255).astype(np.uint8)


def band(first, count, share):
    """Light that rows keep."""
    light = np.ones(HEIGHT)
    light[first : first + count] = 1 - share
    return light


def bands_of(*images):
    bands = LightBands(HEIGHT)
    for image in images:
        bands.add(image)
    return bands


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_what_bands_take_is_measured_and_taken_out(share):
    frames = [checkers(band(first, 60, share), seed=first) for first in (50, 200, 350)]
    bands = bands_of(*frames)
    assert bands.loss == pytest.approx(share, abs=LOSS_TOLERANCE)
    assert f"{bands.loss:.0%}" in bands.report
    expected = np.concatenate([np.arange(first, first + 60) for first in (50, 200, 350)])
    np.testing.assert_array_equal(np.flatnonzero(bands.changing), expected)
    bands.take_out(frames[1])
    level = frames[1].mean(axis=1) / frames[1].mean()
    steady = checkers().mean(axis=1) / checkers().mean()
    np.testing.assert_allclose(level, steady, atol=LOSS_TOLERANCE)


def test_colour_is_looked_at_as_grey():
    frames = [np.repeat(checkers(band(k, 60, 0.3))[..., None], 3, axis=2) for k in (50, 200)]
    assert bands_of(*frames).loss == pytest.approx(0.3, abs=LOSS_TOLERANCE)


@pytest.mark.parametrize(
    "second",
    [
        checkers(seed=1),
        checkers(noise=16.0, seed=1),
        checkers(shift=1),
        checkers(0.7),
        checkers(0.0),
    ],
    ids=["the same", "noise", "moved", "darker as a whole", "black"],
)
def test_where_there_are_no_bands_nothing_is_said_or_changed(second):
    bands = bands_of(checkers(), second)
    assert (bands.loss, bands.report) == (0, "")
    image = second.copy()
    bands.take_out(image)
    np.testing.assert_array_equal(image, second)


def test_one_frame_shows_no_change():
    assert not bands_of(checkers(band(100, 60, 0.3))).changing.any()
