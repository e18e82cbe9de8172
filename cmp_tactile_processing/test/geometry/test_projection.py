"""The way from a point to its pixel and back, at grazing angles too, and its analytic Jacobian."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import view_geometry
from cmp_tactile_processing.geometry.refraction import (
    apparent_points,
    apparent_points_with_jacobian,
    refract_rays,
)
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.parts import Camera, RefractingLayer

CAMERAS = {
    "no distortion": Camera("pinhole", 733.0, 740.0, 255.0, 380.0, (0.0,) * 5),
    "plumb_bob": Camera("pinhole", 733.0, 740.0, 255.0, 380.0, (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "equidistant": Camera("equidistant", 733.0, 740.0, 255.0, 380.0, (-0.02, 5e-3, 1e-3, -2e-3)),
}
STACKS = {
    0: (),
    1: (RefractingLayer(-0.014, 1.41),),
    2: (RefractingLayer(-0.014, 1.49), RefractingLayer(-0.0057, 1.41)),
    3: (
        RefractingLayer(-0.014, 1.49),
        RefractingLayer(-0.011, 1.0),
        RefractingLayer(-0.0057, 1.41),
    ),
}
PLACEMENT = ViewPlacement(0, 0, 512, 768, True)
# Five-point differences.  Truncation: (step / distance)^4 of the derivative, 1e-10 with 10 um and
# 3 mm; rounding: 1e-12 px over 10 um, 1e-7 px/m of some 1000 px/m.
STEP_M = 1e-5
RTOL = 1e-9
# What a ray may miss its point by: roundings of the ways, up to 0.7 m at 89 degrees.
ATOL_MISS_M = 1e-12


def _view(lens, layers, centre, forward, right):
    """A camera at `centre` that looks along `forward`, gel frame."""
    z = np.array(forward) / np.linalg.norm(forward)
    x = np.array(right) - (np.array(right) @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(z, x), z]
    T[:3, 3] = -T[:3, :3] @ centre
    return view_geometry("left", CAMERAS[lens], PLACEMENT, T, STACKS[layers])


def _differences(view, points):
    columns = []
    for shift in np.eye(3) * STEP_M:
        ahead, back, far, far_back = (view.project(points + k * shift) for k in (1, -1, 2, -2))
        columns.append((8 * (ahead - back) - (far - far_back)) / (12 * STEP_M))
    return np.stack(columns, axis=-1)


def _check(view, points):
    q, J = view.project_with_jacobian(points)
    np.testing.assert_array_equal(q, view.project(points))
    assert np.isfinite(J).all()
    error = np.abs(J - _differences(view, points)).max(axis=(-1, -2))
    assert (error <= RTOL * np.abs(J).max(axis=(-1, -2))).all()
    origins, directions = view.rays(q)
    miss = np.linalg.norm(np.cross(points - origins, directions), axis=-1)
    assert miss.max() < ATOL_MISS_M


@pytest.mark.parametrize("layers", STACKS)
@pytest.mark.parametrize("lens", CAMERAS)
def test_obliquely_and_on_the_axis(lens, layers):
    """At distance 0 from the camera's vertical, and of the optical axis, the formulas are 0 / 0."""
    view = _view(lens, layers, (-0.012, 0.001, -0.028), (0.4, 0.02, 1.0), (1.0, 0.1, 0.0))
    points = np.random.default_rng(1).uniform((-0.01, -0.01, -0.003), (0.01, 0.01, 0.001), (300, 3))
    _check(view, points)
    view = _view(lens, layers, (0.001, 0.002, -0.03), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    at = np.array([0.001, 0.002, -0.001])
    _check(view, at + np.array([[0.0, 0.0, 0.0], [1e-12, 0.0, 0.0], [0.0, -1e-7, 0.0]]))


@pytest.mark.parametrize("layers", STACKS)
@pytest.mark.parametrize("lens", CAMERAS)
def test_grazing(lens, layers):
    """A camera close under the plate looks along it: rays beyond 89 degrees from the normal."""
    view = _view(lens, layers, (-0.7, 0.0, -0.019), (1.0, 0.0, 0.02), (0.0, 1.0, 0.0))
    rng = np.random.default_rng(2)
    points = rng.uniform((-0.02, -0.02, -0.004), (0.02, 0.02, 0.001), (200, 3))
    if layers:
        into_plate = replace(view, layers=view.layers[:1])
        air = into_plate.rays(view.project(points))[0] - view.centre
        assert np.degrees(np.arctan2(np.hypot(*air[:, :2].T), air[:, 2])).max() > 89
    _check(view, points)


def test_totally_reflected_rays_are_nan():
    """From index 1.5 into air the angle of total reflection is 41.8 degrees."""
    angles = np.radians([0.0, 41.0, 43.0, 80.0])
    within = np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1)
    layers = (RefractingLayer(0.1, 1 / 1.5),)
    origins, directions = refract_rays(np.zeros((4, 3)), within, layers)
    lost = [False, False, True, True]
    np.testing.assert_array_equal(np.isnan(origins).all(axis=1), lost)
    np.testing.assert_array_equal(np.isnan(directions).all(axis=1), lost)
    assert np.isfinite(directions[:2]).all()
    assert directions[1, 0] == pytest.approx(1.5 * np.sin(angles[1]))


@pytest.mark.filterwarnings("error")
def test_nan_stays_nan_without_a_warning():
    centre = np.array([0.002, -0.001, -0.03])
    layers = STACKS[2]
    points = np.array([[np.nan] * 3, [0.01, np.nan, 0.0], [0.01, 0.0, np.nan], [0.01, 0.0, 0.0]])
    bad = [True, True, True, False]
    apparent, J = apparent_points_with_jacobian(centre, points, layers)
    np.testing.assert_array_equal(np.isnan(apparent).any(axis=1), bad)
    np.testing.assert_array_equal(np.isnan(J).any(axis=(1, 2)), bad)
    assert apparent_points(centre, np.zeros((0, 3)), layers).shape == (0, 3)
    directions = np.array([[np.nan] * 3, [0.0, 0.6, 0.8]])
    for array in refract_rays(np.tile(centre, (2, 1)), directions, layers):
        np.testing.assert_array_equal(np.isnan(array).all(axis=1), [True, False])
