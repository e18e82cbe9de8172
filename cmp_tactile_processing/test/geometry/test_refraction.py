"""Refraction at flat layers: closed forms of Snell's law, at grazing angles too."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.geometry.refraction import (
    apparent_points,
    apparent_points_with_jacobian,
    refract_rays,
)
from cmp_tactile_processing.sensor.parts import RefractingLayer

CENTRE = np.array([0.002, -0.001, -0.03])
STACKS = {
    "one": (RefractingLayer(-0.014, 1.41),),
    "two": (RefractingLayer(-0.014, 1.49), RefractingLayer(-0.0057, 1.41)),
    "three": (
        RefractingLayer(-0.014, 1.49),
        RefractingLayer(-0.011, 1.0),
        RefractingLayer(-0.0057, 1.41),
    ),
    "all air": (RefractingLayer(-0.02, 1.0), RefractingLayer(-0.01, 1.0)),
}
ANGLES = np.radians([0.0, 1e-7, 0.01, 10.0, 30.0, 60.0, 85.0, 89.0, 89.9, 89.99])
# What a ray may miss its point by: a few roundings of the distances, up to 92 m at 89.99 degrees
# where the air below the plate is 16 mm thick.
ATOL_M = 1e-12


def _reached(angles, layers, z):
    """Distance from the camera's vertical at height z, by Snell's law in sines, (N,) m."""
    edges = [CENTRE[2], *(layer.z for layer in layers), np.inf]
    indices = [1.0, *(layer.index for layer in layers)]
    total = np.zeros_like(angles)
    for low, high, index in zip(edges[:-1], edges[1:], indices, strict=True):
        depth = max(min(high, z) - low, 0.0)
        inside = angles if index == 1 else np.arcsin(np.sin(angles) / index)
        total += depth * np.tan(inside)
    return total


@pytest.mark.parametrize("z", [-0.016, -0.0125, -0.008, 0.0, 0.001])
@pytest.mark.parametrize("stack", STACKS)
def test_the_ray_to_a_point_is_found_at_every_angle(stack, z):
    layers = STACKS[stack]
    across = np.array([0.6, 0.8])
    points = np.zeros((len(ANGLES), 3))
    points[:, :2] = CENTRE[:2] + _reached(ANGLES, layers, z)[:, None] * across
    points[:, 2] = z
    apparent = apparent_points(CENTRE, points, layers) - CENTRE
    found = np.arctan2(np.hypot(apparent[:, 0], apparent[:, 1]), apparent[:, 2])
    scale = np.maximum(_reached(ANGLES, layers, z), 0.01)
    miss = np.abs(_reached(found, layers, z) - _reached(ANGLES, layers, z))
    # Relative to the distance: an angle near 90 degrees is itself rounded.
    rounding = 1e-15 / np.cos(ANGLES)
    assert (miss <= scale * (ATOL_M + rounding)).all()
    np.testing.assert_allclose(apparent[:, 2], z - CENTRE[2], atol=1e-17)


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
    layers = STACKS["two"]
    points = np.array([[np.nan] * 3, [0.01, np.nan, 0.0], [0.01, 0.0, np.nan], [0.01, 0.0, 0.0]])
    bad = [True, True, True, False]
    apparent, J = apparent_points_with_jacobian(CENTRE, points, layers)
    np.testing.assert_array_equal(np.isnan(apparent).any(axis=1), bad)
    np.testing.assert_array_equal(np.isnan(J).any(axis=(1, 2)), bad)
    assert apparent_points(CENTRE, np.zeros((0, 3)), layers).shape == (0, 3)
    directions = np.array([[np.nan] * 3, [0.0, 0.6, 0.8]])
    for array in refract_rays(np.tile(CENTRE, (2, 1)), directions, layers):
        np.testing.assert_array_equal(np.isnan(array).all(axis=1), [True, False])
