"""Optical truth: what is seen is where it projects to, and what is hidden is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Status
from cmp_tactile_simulation.rendering.renderer import OpticalTruth, true_grids
from cmp_tactile_simulation.rendering.surface import DeformedSurface


@pytest.mark.parametrize("name", ["mirror_stereo", "two_view", "distorted", "layers"])
def test_grids_are_the_projection_of_the_surface(rigs, deformed, dent, name):
    sensor = rigs[name]
    surface = deformed(sensor, dent)
    truth, grids = OpticalTruth(sensor).surface(surface), true_grids(sensor, surface)
    for side, view in build_views(sensor).items():
        grid = grids[side]
        assert grid.shape == sensor.pattern.shape
        assert grid.placement == view.placement
        assert (grid.corner_status == Status.MEASURED).all()
        assert grid.found_fraction == 1.0
        assert not grid.reason
        for found, points in (
            (grid.corners, truth.position),
            (grid.row_lines, truth.row_position),
            (grid.col_lines, truth.col_position),
        ):
            np.testing.assert_allclose(found, view.project(points), atol=1e-9)


def test_markers_outside_the_view_are_missing(rigs):
    sensor = rigs["distorted"]
    left = sensor.views["left"]
    cut = replace(sensor, views={"left": replace(left, roi=replace(left.roi, width=150))})
    surface = DeformedSurface.rest(sensor.pattern)
    whole, part = (true_grids(item, surface)["left"] for item in (sensor, cut))
    outside = whole.corners[..., 0] > 149.5
    assert 0 < np.count_nonzero(outside) < outside.size
    np.testing.assert_array_equal(np.isnan(part.corners[..., 0]), outside)
    np.testing.assert_array_equal(part.corner_status == Status.MISSING, outside)
    np.testing.assert_array_equal(np.isnan(part.row_lines[..., 0]), part.row_line_status == 0)
    np.testing.assert_allclose(part.corners[~outside], whole.corners[~outside], atol=1e-9)
    assert part.reason == f"{np.count_nonzero(outside)} corners hidden or outside the view"


def test_markers_that_the_surface_hides_are_missing(rigs, deformed):
    """A steep bulge: each marker against a march along its own ray."""
    sensor = rigs["aslant"]

    def field(x, y):
        return [0 * x, 0 * x, -4e-3 * np.exp(-(x**2 + y**2) / (2 * 1e-3**2))]

    surface = deformed(sensor, field)
    grids = true_grids(sensor, surface)
    corners, hidden_in_all = surface.corners(), 0
    for side, view in build_views(sensor).items():
        origin = view.centre
        share = np.linspace(0.5, 1 - 1e-4, 4000)
        p = origin + share[:, None, None, None] * (corners - origin)
        height = p[..., 2] - surface.at_material(p[..., :2])[..., 2]
        hidden = (height > 2e-6).any(axis=0)
        np.testing.assert_array_equal(grids[side].corner_status == Status.MISSING, hidden)
        assert np.isnan(grids[side].corners[hidden]).all()
        hidden_in_all += np.count_nonzero(hidden)
    assert hidden_in_all > 0
