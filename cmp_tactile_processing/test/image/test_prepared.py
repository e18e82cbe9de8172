"""Image preparation: noise, contrast, salt and pepper, smoothing."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.image.prepared import Prefilter, contrast_of, noise_of


@pytest.fixture(scope="module")
def image(checkers):
    return checkers(n=9)


def prepared(grey, side_px=17.0):
    return Prefilter(grey.shape, side_px).prepare(grey)


@pytest.mark.parametrize("blur_px", [0.6, 0.8, 3.0])
@pytest.mark.parametrize("noise", [1.0, 4.0, 16.0])
def test_noise_is_known_in_spite_of_edges(noise, blur_px, checkers):
    """Within 15 %, a tenth for the number of samples and the rest for edges."""
    image = checkers(n=9, blur_px=blur_px)
    assert noise_of(image.render(noise)) == pytest.approx(np.hypot(noise, 12**-0.5), rel=0.15)


@pytest.mark.parametrize("side_px", [3.0, 5.0, 9.0])
def test_noise_of_small_checkers_is_not_that_of_their_edges(side_px, checkers):
    """They have no flat part; edges may pass for one grey level and a half."""
    image = checkers(side_px=side_px, n=15)
    assert noise_of(image.render()) < 1.5
    assert noise_of(image.render(4.0)) == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("side_px", [3.0, 5.0, 8.0, 17.0])
@pytest.mark.parametrize("blur_px", [0.4, 0.8])
def test_clean_images_stay_as_they_are(side_px, blur_px, checkers):
    """The tips and centres of sharp or small checkers are no salt and pepper."""
    images = [checkers(side_px=side_px, angle=a, blur_px=blur_px) for a in (0.0, 0.4, np.pi / 4)]
    greys = [image.render(1.0) for image in images]
    # Noise is none either.  A window cut from a frame is not contiguous; what comes out is.
    for grey in (*greys, checkers(n=9, half=80).render(16.0)[3:90, 7:120]):
        result = prepared(grey, side_px)
        np.testing.assert_array_equal(result.grey, grey)
        assert result.grey.flags.c_contiguous
        assert result.replaced is None


@pytest.mark.parametrize("share", [0.003, 0.03, 0.1])
def test_salt_and_pepper_are_replaced_and_clean_pixels_kept(share, image, with_salt_and_pepper):
    clean = image.render(1.0)
    spoilt, where = with_salt_and_pepper(clean, share)
    result = prepared(spoilt)
    assert result.replaced is not None
    np.testing.assert_array_equal(result.replaced, result.grey != spoilt)
    # Of 0 and 255 in an image from 60 to 160 all are impulses; tips of checkers pass for some.
    assert np.mean(result.replaced[where]) > 0.98
    assert np.mean(result.replaced[~where]) < 0.003
    # On edges a replaced pixel is known to a part of the contrast of 100.
    error = result.grey[where].astype(float) - clean[where]
    assert np.sqrt(np.mean(error**2)) < 12
    assert np.median(np.abs(error)) <= 1.5
    assert result.noise == pytest.approx(noise_of(clean), rel=0.25)
    assert result.contrast == pytest.approx(contrast_of(clean), rel=0.05)


@pytest.mark.parametrize("level", [0, 7, 255])
def test_black_dark_and_saturated_images(level):
    result = prepared(np.full((60, 70), level, np.uint8))
    assert result.contrast < 1
    np.testing.assert_allclose(result.smooth, level, atol=1e-3)
