"""The deformed surface: rest shape, spline, derivatives, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_simulation.rendering.surface import DeformedSurface, surface_point

SHAPES = {
    "plane": PatternSurface(),
    "sphere": PatternSurface("sphere_cap", 0.027),
    "cylinder_x": PatternSurface("cylinder", 0.02, "x"),
    "cylinder_y": PatternSurface("cylinder", 0.02, "y"),
}
# Rounding of positions of some mm.
ATOL_M = 1e-16


def _pattern(surface):
    return Pattern(6, 8, 1e-3, "dark", 3, surface)


def _on_grid(rows, cols, field):
    grid = SurfaceGrid(rows, cols, (0.016, 0.012))
    y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
    return DeformedSurface(_pattern(SHAPES["sphere"]), grid, np.stack(field(x, y), axis=-1))


def _waves(x, y):
    return [
        1e-3 * np.sin(300 * x) * np.cos(200 * y),
        5e-4 * np.cos(250 * x + 1),
        -1e-3 * np.sin(280 * y - 0.3),
    ]


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_rest_is_the_nominal_pattern(shape):
    pattern = _pattern(shape)
    np.testing.assert_allclose(
        DeformedSurface.rest(pattern).corners(), pattern.corners(), atol=ATOL_M
    )
    i, j = np.array([0.25, 4.9]), np.array([6.5, -0.4])
    np.testing.assert_allclose(
        DeformedSurface.rest(pattern).at(i, j), pattern.at(i, j), atol=ATOL_M
    )


def test_cubic_displacements_are_kept_exactly():
    def field(x, y):
        return [50 * x**3 + y, 1e3 * y**3 * x, 9 * x * y**2 - 2e-4]

    surface = _on_grid(5, 7, field)
    x, y = np.random.default_rng(0).uniform(-0.006, 0.006, (2, 300))
    moved = surface.at_material(np.stack([x, y], axis=-1))
    rest = DeformedSurface.rest(surface.pattern).at_material(np.stack([x, y], axis=-1))
    np.testing.assert_allclose(moved - rest, np.stack(field(x, y), axis=-1), atol=1e-15)


def test_grid_points_are_met():
    surface = _on_grid(13, 11, _waves)
    points, rest = surface.grid.points, DeformedSurface.rest(surface.pattern)
    moved = surface.at_material(points) - rest.at_material(points)
    np.testing.assert_allclose(moved, surface.displacement.reshape(-1, 3), atol=1e-16)


def test_derivatives_agree_with_differences_inside_and_beyond_the_grid():
    surface = _on_grid(13, 11, _waves).spline((0.015, 0.011))
    step = 1e-7
    # The last two lie beyond the grid and beyond the block.
    for x, y in [(0.001, -0.002), (-0.0071, 0.0049), (0.0079, 0.0012), (0.0089, 0.0)]:
        found = np.array(surface_point(surface, x, y))
        along = np.subtract(
            surface_point(surface, x + step, y)[:3], surface_point(surface, x - step, y)[:3]
        )
        across = np.subtract(
            surface_point(surface, x, y + step)[:3], surface_point(surface, x, y - step)[:3]
        )
        np.testing.assert_allclose(found[3:6], along / (2 * step), atol=1e-7)
        if abs(x) < 0.0075:
            np.testing.assert_allclose(found[6:9], across / (2 * step), atol=1e-7)
