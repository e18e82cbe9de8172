"""The depth field of markers, with and without the virtual ones."""

import numpy as np
import pytest

from cmp_tactile_processing.measured import Surface, SurfaceGrid
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.file import load_scene
from paper.readings import DepthField, nodes_of, true_displacement, without_virtual
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
    assert off[0] < 0.15 * DEPTH < 0.2 * DEPTH < off[1]
