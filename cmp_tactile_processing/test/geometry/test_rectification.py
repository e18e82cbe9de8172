"""The rectified pair: what stock stereo nodes make of it is what our own rays give."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rectification import Rectification
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.sensor.parts import Optics, RefractingLayer, Roi, ViewDescription

VIEWS = ("left", "right")
LENSES = {
    "pinhole": ("pinhole", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "distorted": ("pinhole", (-0.1, 0.05, 1e-3, -2e-3, 0.01)),
    "equidistant": ("equidistant", (0.02, -0.01, 0.003, 0.0)),
}
# 3 mm of acrylic below 6 mm of gel.
LAYERS = (RefractingLayer(-0.009, 1.49), RefractingLayer(-0.006, 1.41))
DISPLACEMENTS_M = {
    "none": [0.0, 0.0, 0.0],
    "pressed": [0.0, 0.0, -1e-3],
    "along x": [1e-3, 0.0, 0.0],
    "along y": [0.0, 1e-3, 0.0],
}
# Double precision leaves picometres and 1e-9 px.
ATOL_EXACT_M, ATOL_EXACT_PX = 1e-9, 1e-6
# A drawn spot is rounded to grey levels, and the map's steps are of 1/32 px.
ATOL_SPOT_PX = 0.05


def rig(lens="pinhole", layers=(), name="sample_rig"):
    sensor = load_sensor(name)
    model, distortion = LENSES[lens]
    camera = replace(sensor.camera, model=model, distortion=distortion)
    return replace(sensor, camera=camera, optics=replace(sensor.optics, layers=layers))


def corners(sensor, displacement="none"):
    return sensor.pattern.corners().reshape(-1, 3) + DISPLACEMENTS_M[displacement]


def rectified(rectification, sensor, points):
    """Pixels (N, 2) of both rectified images for points in the gel frame."""
    views = build_views(sensor)
    return [rectification.rectify_points(n, views[n].project(points)) for n in VIEWS]


@pytest.mark.parametrize("lens", LENSES)
def test_stock_algorithms_give_the_true_points(lens):
    """Raw pixels -> K, D, R, P -> cv2.triangulatePoints, by OpenCV's own code throughout."""
    sensor = rig(lens)
    rectification, points = Rectification(sensor), corners(sensor, "pressed")
    infos, pixels = [], []
    for name, view in build_views(sensor).items():
        info = rectification.info(name)
        raw = view.project(points)[:, None]
        if info.model == "plumb_bob":
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-13)
            q = cv2.undistortPointsIter(raw, info.K, info.D, info.R, info.P, criteria)
        else:
            q = cv2.fisheye.undistortPoints(raw, info.K, info.D, R=info.R, P=info.P)
        ours = rectification.rectify_points(name, raw[:, 0])
        np.testing.assert_allclose(q[:, 0], ours, atol=ATOL_EXACT_PX)
        infos.append(info)
        pixels.append(q[:, 0].T)
    np.testing.assert_allclose(pixels[0][1], pixels[1][1], atol=ATOL_EXACT_PX)
    found = rectification.triangulate(pixels[0].T, pixels[1].T)
    np.testing.assert_allclose(found, points, atol=ATOL_EXACT_M, rtol=0)
    p = cv2.triangulatePoints(infos[0].P, infos[1].P, *pixels)
    p_rect = (p[:3] / p[3]).T
    T_gel_rect = np.linalg.inv(rectification.pose("left"))
    np.testing.assert_allclose(
        p_rect @ T_gel_rect[:3, :3].T + T_gel_rect[:3, 3], points, atol=ATOL_EXACT_M, rtol=0
    )


@pytest.mark.parametrize("layers", [(), LAYERS], ids=["straight", "refracted"])
@pytest.mark.parametrize("name", ["sample_rig", "prototype"])
def test_both_cameras_have_one_matrix_and_show_the_pattern(name, layers):
    """stereo_image_proc subtracts a difference of principal points twice: there must be none."""
    sensor = rig(layers=layers, name=name)
    rectification = Rectification(sensor)
    left, right = rectification.info("left"), rectification.info("right")
    np.testing.assert_array_equal(left.P[:, :3], right.P[:, :3])
    assert left.P[:, 3].tolist() == [0, 0, 0]
    T_right_left = rectification.pose("right") @ np.linalg.inv(rectification.pose("left"))
    baseline = -right.P[0, 3] / right.P[0, 0]
    # The right camera is ahead along x, and parallel.
    expected = np.eye(4)
    expected[0, 3] = -baseline
    np.testing.assert_allclose(T_right_left, expected, atol=1e-12)
    assert baseline > 0
    for q in rectified(rectification, sensor, corners(sensor)):
        assert (q > 10).all()
        assert (q < [left.width - 11, left.height - 11]).all()


LIMITS_M = {"none": 1e-9, "pressed": 40e-6, "along x": 13e-6, "along y": 9e-6}


@pytest.mark.parametrize("displacement", DISPLACEMENTS_M)
def test_behind_layers_p_is_exact_at_rest_and_near_it_elsewhere(displacement):
    """The limits are those of docs/conventions.md for the sample rig and 1 mm."""
    sensor = rig("distorted", LAYERS)
    rectification, points = Rectification(sensor), corners(sensor, displacement)
    left, right = rectified(rectification, sensor, points)
    off = np.linalg.norm(rectification.triangulate(left, right) - points, axis=1)
    assert off.max() < LIMITS_M[displacement]
    if displacement == "pressed":
        assert np.sqrt(np.mean(off**2)) < 12.5e-6


def test_what_is_not_seen_is_nan(sensor):
    rectification = Rectification(rig(layers=LAYERS))
    q = np.array([[np.nan, 5.0], [256.0, 384.0], [-1e6, 384.0]])
    found = rectification.rectify_points("left", q)
    assert np.isnan(found).any(axis=1).tolist() == [True, False, True]
    # The left pixel must be to the right of the right one for rays that meet in front.
    left = np.array([[300.0, 400.0], [300.0, 400.0], [np.nan, 400.0]])
    right = np.array([[100.0, 400.0], [300.0, 400.0], [100.0, 400.0]])
    points = Rectification(sensor).triangulate(left, right)
    assert np.isnan(points).all(axis=1).tolist() == [False, True, True]


def monocular(sensor):
    optics = replace(sensor.optics, type="monocular")
    return replace(sensor, optics=optics, views={"right": sensor.views["right"]})


@pytest.mark.parametrize("layers", [(), LAYERS], ids=["straight", "refracted"])
def test_monocular_view_is_undistorted_only(layers):
    sensor = monocular(rig("distorted", layers))
    rectification, view = Rectification(sensor), build_views(sensor)["right"]
    info = rectification.info("right")
    np.testing.assert_array_equal(info.R, np.eye(3))
    np.testing.assert_array_equal(info.P, np.column_stack([info.K, np.zeros(3)]))
    np.testing.assert_array_equal(info.K, view.lens.matrix)
    np.testing.assert_array_equal(rectification.pose("right"), view.T_view_gel)
    xy = np.array([[0.1, -0.2], [-0.3, 0.25]])
    raw = view.lens.project(np.column_stack([xy, np.ones(2)]))
    expected = xy @ info.K[:2, :2].T + info.K[:2, 2]
    np.testing.assert_allclose(
        rectification.rectify_points("right", raw), expected, atol=ATOL_EXACT_PX
    )
    with pytest.raises(InputError, match="found no view 'left', expected one of right"):
        rectification.triangulate(expected, expected)


def test_one_camera_behind_the_other_is_reported(sensor):
    """Along its own line of sight there is no direction for the rows of a pair."""
    left = build_views(sensor)["left"]
    poses = [left.T_view_gel, left.T_view_gel + np.eye(4, k=1) @ np.diag([0, 0, 0, 5e-3])]
    views = {
        name: ViewDescription(Roi(0, 0, 512, 768), None, sensor.camera, pose)
        for name, pose in zip(VIEWS, poses, strict=True)
    }
    camera = replace(sensor.camera, cx=left.lens.matrix[0, 2])
    views = {name: replace(view, camera=camera) for name, view in views.items()}
    behind = replace(sensor, camera=None, optics=Optics("two_view", None, ()), views=views)
    with pytest.raises(InputError, match="views: found the left camera beside or behind"):
        Rectification(behind)


@pytest.mark.parametrize("layers", [(), LAYERS], ids=["straight", "refracted"])
@pytest.mark.parametrize("lens", LENSES)
def test_images_and_points_are_rectified_alike(lens, layers):
    """Behind layers too, where no stock model of the lens holds: refraction is in the image."""
    sensor = rig(lens, layers)
    rectification = Rectification(sensor)
    for name, view in build_views(sensor).items():
        info = rectification.info(name)
        y, x = np.mgrid[: info.height, : info.width]
        for spot in view.project(corners(sensor)[[43, 210, 356]]):
            distance = np.hypot(x - spot[0], y - spot[1])
            drawn = np.rint(250 * np.exp(-0.5 * (distance / 3) ** 2)).astype(np.uint8)
            grey = rectification.rectify(name, drawn).astype(float)
            found = np.array([(grey * x).sum(), (grey * y).sum()]) / grey.sum()
            (expected,) = rectification.rectify_points(name, spot[None])
            assert np.abs(found - expected).max() < ATOL_SPOT_PX
