"""The surface as triangles by colour: each once, through the virtual markers, in its step."""

from dataclasses import replace

import numpy as np
import pytest
from made_forces import made_field

from cmp_tactile_processing.measured import GridShape, Surface
from cmp_tactile_viewer.meshes import (
    BANDS,
    EMPTY,
    ColourRange,
    colour_bands,
    pressure_at,
    refined,
    refined_surface,
    whole_mesh,
)

SHAPE = GridShape(4, 5, 6)
PITCH = 1e-3


def bowl(x, y):
    return np.stack([x, y, 40.0 * (x**2 + y**2)], axis=-1)


def surface_on(function):
    """All markers of a surface at these heights, the virtual ones too."""
    x, y = np.meshgrid(PITCH * np.arange(5.0), PITCH * np.arange(4.0))
    share = (np.arange(6) + 1) / 7 * PITCH
    corners = function(x, y)
    rows = function(x[:, :-1, None] + share, np.repeat(y[:, :-1, None], 6, axis=2))
    cols = function(np.repeat(x[:-1, :, None], 6, axis=2), y[:-1, :, None] + share)
    flat = corners * (1, 1, 0)
    return Surface.from_exact_points(SHAPE, flat, corners, rows, cols)


def test_the_refined_surface_lies_on_the_true_one_between_the_markers_too():
    """A paraboloid's Coons patch is the paraboloid itself; the middle of a line is the mean of the
    two virtual markers beside it, a 14th of the pitch off: 40 / m * (pitch / 14)^2 too high."""
    fine = refined_surface(surface_on(bowl))
    error = fine[..., 2] - 40.0 * (fine[..., 0] ** 2 + fine[..., 1] ** 2)
    assert fine.shape == (7, 9, 3)
    assert np.abs(error).max() <= 2.001 * 40.0 * (PITCH / 14) ** 2
    straight = refined(surface_on(bowl).position)
    chord = straight[..., 2] - 40.0 * (straight[..., 0] ** 2 + straight[..., 1] ** 2)
    assert np.abs(chord).max() > 10 * np.abs(error).max()


def test_a_lost_virtual_marker_is_replaced_by_the_middle_of_its_line():
    surface = surface_on(bowl)
    rows = surface.row_position.copy()
    rows[1, 2] = np.nan
    fine = refined_surface(replace(surface, row_position=rows))
    assert fine[2, 5] == pytest.approx((surface.position[1, 2] + surface.position[1, 3]) / 2)


def test_a_pattern_without_virtual_markers_is_drawn_with_the_middles_of_its_lines():
    surface = surface_on(bowl)
    bare = replace(
        surface,
        shape=GridShape(4, 5, 0),
        row_position=np.empty((4, 4, 0, 3)),
        col_position=np.empty((3, 5, 0, 3)),
    )
    fine = refined_surface(bare)
    assert fine[2, 5] == pytest.approx((surface.position[1, 2] + surface.position[1, 3]) / 2)
    assert np.isfinite(fine).all()


def test_every_triangle_has_one_colour_that_is_the_step_of_its_value():
    surface = surface_on(bowl)
    points, values = surface.position, surface.position[..., 2]
    top = float(values.max())
    bands = colour_bands(points, values, top)
    filled = [mesh for mesh in bands if mesh is not EMPTY]
    assert len(bands) == BANDS
    assert sum(len(mesh.faces) for mesh in filled) == 2 * 3 * 4
    for number, mesh in enumerate(bands):
        if mesh is EMPTY:
            continue
        means = mesh.vertices[mesh.faces][..., 2].mean(axis=1) * 1e-3
        assert (np.clip(np.floor(means / top * BANDS), 0, BANDS - 1) == number).all()


def test_a_missing_marker_is_a_hole_of_its_four_cells():
    points = surface_on(bowl).position.copy()
    points[1, 2] = np.nan
    assert len(whole_mesh(points).faces) == 2 * (3 * 4 - 4)
    assert np.isfinite(whole_mesh(points).vertices).all()


def test_pressure_is_the_force_of_a_node_on_its_area_and_linear_between_the_nodes():
    x, y = np.meshgrid(PITCH * np.arange(5.0), PITCH * np.arange(4.0))
    nodes = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    force = np.zeros((20, 3))
    force[:, 2] = -(1.0 + nodes[:, 0] / PITCH)
    field = made_field(4, 5, position=nodes, force=force)
    surface = surface_on(bowl)
    moved = replace(surface, reference=surface.reference + (PITCH / 4, 0, 0))
    found = pressure_at(moved, field)
    expected = (1.0 + np.arange(5.0) + 0.25) / PITCH**2
    assert found[1, :4] == pytest.approx(expected[:4])
    assert found[1, 4] == 0.0  # outside of all nodes


def test_the_colours_end_at_a_round_number_that_forgets_a_knock():
    """And stays above what is pressed now, also where a recording is gone back in."""
    press = np.array([0.0003, np.nan])
    colours, second = ColourRange("depth", 1e-4), 10**9
    colours.take(np.array([5e-5]), 100 * second)
    assert colours.top == pytest.approx(1e-4)
    colours.take(np.array([0.0013]), 101 * second)
    assert colours.top == pytest.approx(0.002)
    for stamp_ns in (101 * second + second // 20, 50 * second):
        colours.take(press, stamp_ns)
        assert colours.top == pytest.approx(0.002)
    for later in range(1, 61):
        colours.take(press, (50 + later) * second)
        assert colours.top >= 0.0003
    assert colours.top == pytest.approx(5e-4)
    colours.start("depth", 1e-4)
    assert colours.top == pytest.approx(5e-4)
    colours.start("pressure", 5e3)
    assert colours.top == pytest.approx(5e3)
