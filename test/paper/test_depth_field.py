"""The depth field of markers, with and without the virtual ones."""

import numpy as np
import pytest

from cmp_tactile_processing.measured import Status, Surface, SurfaceGrid
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from paper.readings import DepthField, nodes_of, sampled, true_displacement, without_virtual
from paper.sequence import PrintedGel

SENSOR = load_scene("probe").sensor
DEPTH = 0.3e-3


def dented(width: float) -> DeformedSurface:
    """A dent of this width (standard deviation), m, on a gridline half way between two corners."""
    grid = SurfaceGrid(111, 111, (0.022, 0.022))
    x, y = grid.points.reshape(111, 111, 2).transpose(2, 0, 1)
    y = y - SENSOR.pattern.pitch / 2
    displacement = np.zeros((111, 111, 3))
    displacement[..., 2] = -DEPTH * np.exp(-(x**2 + y**2) / 2 / width**2)
    return DeformedSurface(SENSOR.pattern, grid, displacement)


def markers(surface: DeformedSurface) -> Surface:
    return PrintedGel(SENSOR, "cmp").truth(surface).surface


def test_virtual_markers_see_what_lies_between_corners() -> None:
    surface, field = dented(0.35e-3), DepthField(SENSOR.pattern, 0.1e-3)
    true = -true_displacement(surface, nodes_of(field.grid))[..., 2]
    seen = markers(surface)
    off = [
        float(np.nanmax(np.abs(field.depth(item) - true))) for item in (seen, without_virtual(seen))
    ]
    assert true.max() == pytest.approx(DEPTH, rel=1e-2)
    # With virtual markers only the middle of a cell is interpolated.
    assert off[0] < 0.15 * DEPTH < 0.3 * DEPTH < off[1]


def test_wide_dent_is_the_same_with_and_without_virtual_markers() -> None:
    surface, field = dented(2e-3), DepthField(SENSOR.pattern, 0.1e-3)
    true = -true_displacement(surface, nodes_of(field.grid))[..., 2]
    for item in (markers(surface), without_virtual(markers(surface))):
        # Of 0.3 mm; cubic curves through a dent of three pitches.
        assert np.nanmax(np.abs(field.depth(item) - true)) < 1e-6


def test_only_virtual_markers_are_taken_away() -> None:
    seen = markers(dented(1e-3))
    corners = without_virtual(seen)
    assert np.array_equal(corners.position, seen.position)
    assert np.array_equal(corners.status, seen.status)
    for name in ("row", "col"):
        assert np.isnan(getattr(corners, f"{name}_position")).all()
        assert (getattr(corners, f"{name}_status") == Status.MISSING).all()
        assert (getattr(seen, f"{name}_status") == Status.MEASURED).all()


def test_field_is_sampled_at_x_and_y_and_not_beyond_its_nodes() -> None:
    grid = SurfaceGrid(5, 9, (8e-3, 4e-3))
    nodes = nodes_of(grid)
    field = 2 * nodes[..., 0] - 3 * nodes[..., 1]
    places = np.array([[1.3e-3, -0.4e-3], [-3.9e-3, 1.9e-3], [4.1e-3, 0.0]])
    expected = [2 * 1.3e-3 + 3 * 0.4e-3, -2 * 3.9e-3 - 3 * 1.9e-3]
    found = sampled(grid, field, places)
    assert found[:2] == pytest.approx(expected)
    assert np.isnan(found[2])
