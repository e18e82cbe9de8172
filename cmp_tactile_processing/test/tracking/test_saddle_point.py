"""Sub-pixel corners against images in closed form: bias, noise, what they claim, capture range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.image.prepared import Prefilter
from cmp_tactile_processing.tracking.corners.saddle_point import SaddlePointFit

# Largest error on an image without noise, px per coordinate.  Rounding to grey levels makes
# 0.3 grey / (slope 40 grey/px * root of some 20 pixels on the edges), 0.002 px at a blur of 1 px,
# 0.003 px at 2 px; four times that in the worst of fifty coordinates.
ATOL_CLEAN_PX = 0.012
# Displacement that a flaw of the print may feign.
FLAWED_PRINT_PX = 0.08


def fitted(image, grey, start=None, reach=0.5):
    prepared = Prefilter(grey.shape, image.side_px).prepare(grey)
    start = image.corners() if start is None else start
    return SaddlePointFit(image.side_px).fit(prepared, start, reach * image.side_px)


def rms(error):
    return float(np.sqrt(np.mean(np.sum(np.square(error), axis=-1))))


@pytest.mark.parametrize(
    ("seen", "atol"),
    [
        ({"angle": 0.0}, ATOL_CLEAN_PX),
        ({"angle": np.pi / 4}, ATOL_CLEAN_PX),
        ({"angle": 1.1, "phase": (-0.5, 0.5)}, ATOL_CLEAN_PX),
        ({"shear": 0.4}, ATOL_CLEAN_PX),
        ({"blur_px": 0.5}, ATOL_CLEAN_PX),
        ({"blur_px": 2.0}, ATOL_CLEAN_PX),
        ({"side_px": 9.0}, ATOL_CLEAN_PX),
        ({"side_px": 40.0, "n": 3}, ATOL_CLEAN_PX),
        ({"squeeze": 0.7}, ATOL_CLEAN_PX),
        # 5 % of light from checker to checker would move the saddle point by 0.06 px.  The model
        # has a slope of the light, but one contrast: a tenth is left beside the rounding.
        ({"light": 0.05}, ATOL_CLEAN_PX + 0.006),
        # Twice the turn from checker to checker of a firm press.  Without the curvatures in the
        # model the corner would go by 0.03 rad / 17 px * (5 px)^2 / 2.
        ({"bend": 0.03}, 0.015),
        # Too small for the model of one corner: the saddle point of the quadratic alone, whose
        # window reaches the neighbours; the rest is what sharp undersampled edges leave.
        ({"side_px": 3.0, "n": 9, "blur_px": 0.7}, 0.04),
        ({"side_px": 6.0, "n": 9, "blur_px": 0.7}, 0.04),
    ],
    ids=str,
)
def test_no_bias_whatever_the_checkers_look_like(seen, atol, checkers):
    image = checkers(**seen)
    found = fitted(image, image.render())
    np.testing.assert_allclose(found.position, image.corners(), atol=atol)


@pytest.mark.parametrize("side_px", [5.0, 17.0])
@pytest.mark.parametrize("noise", [0.5, 1.0, 4.0, 16.0])
def test_standard_deviation_is_honest(side_px, noise, checkers):
    """Errors over 10 seeds are what `std` says, within a quarter.

    On images with little noise rounding to grey levels is a third of the error, which is not white.
    """
    image = checkers(side_px=side_px)
    ratio = []
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        turned = replace(image, angle=rng.uniform(0, np.pi), phase=tuple(rng.uniform(-0.5, 0.5, 2)))
        found = fitted(turned, turned.render(noise, seed))
        ratio.append((found.position - turned.corners()) / found.std[:, None])
    z = np.concatenate(ratio)
    z = z[np.isfinite(z).all(axis=1)]
    assert len(z) > 0.98 * 250 if noise < 16 or side_px > 10 else len(z) > 100
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.25


def test_error_follows_the_noise(checkers):
    """In proportion to it, and no more than a tenth above the bound of an unbiased estimate.

    Cramer and Rao for one edge of an image blurred by 0.8 px and the pixel (0.85 px together):
    a pixel's length of it gives (2 * 50)^2 / (2 root(pi) 0.85) / noise^2, of an edge some 9 px
    count in a window of 8.5 px that falls to zero.  Both coordinates together, noise 16: 0.13 px.
    """
    image = checkers()
    error = {}
    for noise in (4.0, 16.0):
        found = [fitted(image, image.render(noise, seed)).position for seed in range(6)]
        error[noise] = rms(np.array(found) - image.corners())
    bound = 16 * np.sqrt(2) * np.sqrt(2 * np.sqrt(np.pi) * 0.85 / 9) / 100
    assert error[16.0] < 1.1 * bound
    assert 3 < error[16.0] / error[4.0] < 5


def test_corners_of_one_image_share_its_light(checkers):
    """A blurred edge alone could be a slope of the light; those before show that there is none.

    The first four corners find that out for themselves.
    """
    image = checkers(blur_px=3.0)
    together, alone = [], []
    for seed in range(4):
        grey, true = image.render(2.0, seed), image.corners()
        together.append(fitted(image, grey).position - true)
        each = [fitted(image, grey, corner[None]).position[0] for corner in true]
        alone.append(np.array(each) - true)
    assert rms(np.array(together)[:, 4:]) < 0.9 * rms(np.array(alone)[:, 4:])


def test_a_blob_within_the_window_moves_the_corner_little(checkers):
    """Missing ink of 4 px on an edge, 6.5 px from the corner: outliers to the model."""
    image = checkers(n=3)
    grey = image.render(1.0)
    middle = image.corners()[4]
    along = middle + 6.5 * np.array([np.cos(image.angle), np.sin(image.angle)])
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
    blob = np.hypot(x - along[0], y - along[1]) <= 2
    spoilt = np.where(blob, 160, grey).astype(np.uint8)
    moved = fitted(image, spoilt).position[4] - fitted(image, grey).position[4]
    assert np.linalg.norm(moved) < FLAWED_PRINT_PX


def test_a_grain_at_the_corner_shows_in_its_deviation(checkers):
    """Where no model of a corner fits: a grain of 4 px moves the saddle point by up to 1 px.

    So large an error also shows against the neighbours; alone it is within four deviations.
    """
    image = checkers(n=3)
    grey, middle = image.render(1.0), image.corners()[4]
    y, x = np.mgrid[: grey.shape[0], : grey.shape[1]]
    ratio = []
    for away in (1.0, 2.0, 3.0):
        for angle in np.arange(16) * np.pi / 8:
            at = middle + away * np.array([np.cos(angle), np.sin(angle)])
            grain = np.hypot(x - at[0], y - at[1]) <= 2
            found = fitted(image, np.where(grain, 20, grey).astype(np.uint8))
            assert not found.pull[~found.modelled].any()
            if np.isfinite(found.std[4]) and not found.modelled[4]:
                ratio.append((found.position[4] - middle) / found.std[4])
    assert len(ratio) > 10
    assert np.sqrt(np.mean(np.square(ratio))) < 4


def returning(image, share):
    """Share of starts, `share` sides away in 16 directions, that come back to their corner."""
    grey = image.render(1.0)
    prepared = Prefilter(grey.shape, image.side_px).prepare(grey)
    fit = SaddlePointFit(image.side_px)
    back = []
    for angle in np.arange(16) * np.pi / 8:
        away = share * image.side_px * np.array([np.cos(angle), np.sin(angle)])
        found = fit.fit(prepared, image.corners() + away, image.side_px)
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(found.position - image.corners(), axis=1) < 0.1
        back.append(near)
    return float(np.mean(back))


@pytest.mark.parametrize("side_px", [4.0, 8.0, 17.0, 40.0])
def test_capture_range(side_px, checkers):
    """Measured: all starts up to 0.3 sides away come back, a quarter from 0.4, none from 0.5.

    At half a side another corner is as near, or there is none that way.
    """
    image = checkers(side_px=side_px, n=3)
    assert returning(image, 1 / 6) == 1
    assert returning(image, 0.3) > 0.98


def test_nothing_is_found_where_no_saddle_is():
    flat = np.full((60, 60), 90, np.uint8)
    edge = np.where(np.arange(60) < 30, 40, 160).astype(np.uint8) + np.zeros((60, 1), np.uint8)
    y, x = np.mgrid[:60, :60]
    hill = (200 - ((x - 30) ** 2 + (y - 30) ** 2) / 10).clip(0).astype(np.uint8)
    start = np.array([[30.0, 30.0], [20.3, 31.0]])
    for grey in (flat, edge, hill):
        prepared = Prefilter(grey.shape, 12.0).prepare(grey)
        found = SaddlePointFit(12.0).fit(prepared, start, 6.0)
        assert np.isnan(found.position).all()
        assert np.isnan(found.std).all()
