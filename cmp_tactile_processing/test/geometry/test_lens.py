"""Lenses invert exactly inside their field and give NaN outside it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.geometry.lens import ACCURACY, LEAST_SLOPE, Lens

MATRIX = np.array([[733.0, 0.0, 511.0], [0.0, 740.0, 380.0], [0.0, 0.0, 1.0]])
# A pixel's rounding, and that of the polynomial, on coordinates of some thousand px.
ATOL_PX = 1e-9

LENSES = {
    "pinhole": ("pinhole", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "barrel": ("pinhole", (-0.3, 0.0, 0.0, 0.0, 0.0)),
    "100 degrees": ("pinhole", (-0.3, 0.1, 0.0, 0.0, -0.012)),
    "moustache": ("pinhole", (-0.5, 0.4, 1e-3, -2e-3, -0.1)),
    "pincushion": ("pinhole", (0.3, 0.1, 0.0, 0.0, 0.05)),
    "decentred": ("pinhole", (-0.2, 0.05, 0.03, -0.05, 0.01)),
    "only decentred": ("pinhole", (0.0, 0.0, 2e-3, 1e-3, 0.0)),
    "ideal fisheye": ("equidistant", (0.0, 0.0, 0.0, 0.0)),
    "fisheye": ("equidistant", (-0.02, 5e-3, 1e-3, -2e-3)),
    "narrow fisheye": ("equidistant", (-0.4, 0.0, 0.0, 0.0)),
}


def _lens(name):
    model, distortion = LENSES[name]
    return Lens(model, MATRIX, np.array(distortion))


def _directions(lens, count=3000, seed=1):
    """Unit directions all over the field, its middle and its very rim included."""
    rng = np.random.default_rng(seed)
    # A pinhole's pixels beyond 85 degrees are too far out to be known to ACCURACY.
    angle = min(lens.widest_angle, np.radians(179 if lens.model == "equidistant" else 85))
    theta = angle * np.sqrt(rng.uniform(0, 1, count))
    theta[:4] = 0.0, 1e-12 * angle, angle * (1 - 1e-6), angle * (1 - 1e-12)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=1)


@pytest.mark.parametrize("name", LENSES)
def test_the_pixel_of_a_direction_is_opencvs_and_gives_the_direction_back(name):
    """OpenCV has no equidistant lens beyond 90 degrees: those are compared in test_view_kinds."""
    lens = _lens(name)
    v = _directions(lens)
    q = lens.project(v)
    np.testing.assert_allclose(lens.directions(q), v, atol=ACCURACY, rtol=0)
    if lens.model == "pinhole":
        expected = cv2.projectPoints(v, np.zeros(3), np.zeros(3), MATRIX, lens.distortion)[0]
        np.testing.assert_allclose(q, expected[:, 0], atol=ATOL_PX, rtol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_lenses_of_any_shape_invert_all_over_their_field(seed):
    """A solver that leaves the right branch, or gives up, anywhere would break this."""
    rng = np.random.default_rng(seed)
    pinhole = Lens("pinhole", MATRIX, rng.normal(size=5) * (0.4, 0.3, 0.03, 0.03, 0.2))
    fisheye = Lens("equidistant", MATRIX, rng.normal(size=4) * (0.1, 0.1, 0.05, 0.05))
    for lens in (pinhole, fisheye):
        v = _directions(lens, 500, seed)
        np.testing.assert_allclose(lens.directions(lens.project(v)), v, atol=ACCURACY, rtol=0)


def test_the_field_ends_where_the_image_folds_back():
    """r (1 - 0.3 r^2) is largest at r = 1 / sqrt(0.9), where its slope 1 - 0.9 r^2 is 0."""
    lens = _lens("barrel")
    limit = np.sqrt((1 - LEAST_SLOPE) / 0.9)
    assert np.tan(lens.widest_angle) == pytest.approx(limit, rel=1e-12)
    inside, outside = limit * (1 - 1e-9), limit * (1 + 1e-9)
    q = lens.project(np.array([[inside, 0, 1], [outside, 0, 1], [1.8, 0, 1], [0, 0.5, 1]]))
    np.testing.assert_array_equal(np.isnan(q[:, 0]), [False, True, True, False])
    # What OpenCV makes of the third point: a pixel right in the image.
    folded = cv2.projectPoints(
        np.array([[1.8, 0.0, 1.0]]), np.zeros(3), np.zeros(3), MATRIX, lens.distortion
    )[0][0, 0]
    assert abs(folded[0] - 511) < 100
    largest = limit - 0.3 * limit**3
    q = np.array([[511 + 733 * largest * (1 + share), 380.0] for share in (-1e-9, 1e-9)])
    np.testing.assert_array_equal(np.isnan(lens.directions(q)[:, 0]), [False, True])


def test_a_fisheye_sees_behind_its_image_plane():
    lens = _lens("ideal fisheye")
    theta = np.radians([30.0, 90.0, 120.0, 178.0, 179.5])
    v = np.stack([np.sin(theta), np.zeros(5), np.cos(theta)], axis=1)
    q = lens.project(v * 0.03)
    np.testing.assert_allclose(q[:4, 0], 511 + 733 * theta[:4], atol=ATOL_PX)
    assert np.isnan(q[4]).all()
    np.testing.assert_allclose(lens.directions(q[:4]), v[:4], atol=ACCURACY, rtol=0)
    assert np.isnan(lens.directions(np.array([[511 + 733 * np.radians(179.5), 380.0]]))).all()


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.filterwarnings("error")
def test_nan_and_what_is_not_in_front_have_no_pixel_and_give_no_warning(name):
    lens = _lens(name)
    nan = np.nan
    behind = [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1e-9, 0.0, -1.0]]
    v = np.array([[0.1, 0.2, 1.0], *behind, [nan, nan, nan], [0.1, nan, 1.0], [0.1, 0.1, nan]])
    q, J = lens.project_with_jacobian(v)
    seen = np.arange(len(v)) == 0
    np.testing.assert_array_equal(np.isfinite(q).all(axis=1), seen)
    np.testing.assert_array_equal(np.isfinite(J).all(axis=(1, 2)), seen)
    assert np.isnan(q[1:4]).all()
    assert np.isnan(J[1:4]).all()
    np.testing.assert_array_equal(lens.project(v), q)
    v = lens.directions(np.array([[nan, nan], [nan, 5.0], [500.0, 300.0]]))
    np.testing.assert_array_equal(np.isnan(v).any(axis=1), [True, True, False])
    assert lens.directions(np.zeros((0, 2))).shape == (0, 3)
    assert lens.project(np.zeros((0, 3))).shape == (0, 2)
