"""The dense surface against surfaces in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import Surface, SurfaceGrid
from cmp_tactile_processing.sensor.parts import Pattern, PatternSurface
from cmp_tactile_processing.surface.dense import (
    DenseStatus,
    SurfaceInterpolator,
    grid_over,
    height_map,
    interpolate,
)

EXTENT = 0.0131
RADIUS = 0.027
# Share of a step, a quarter of a checker wide, by which the surface over- or undershoots: measured
# 0.21.  A patch that only adds up both directions does so by 0.34.
MOST_OVERSHOOT = 0.22


def bump(x, y, width=3e-3, depth=8e-4):
    """A smooth press and drag; (..., 3) m."""
    share = np.exp(-((x - 4e-4) ** 2 + (y + 7e-4) ** 2) / width**2)
    return np.stack(
        [4e-4 * share + 0.03 * y, -3e-4 * share * np.cos(x / width), -depth * share], -1
    )


def pattern_of(rows, cols, n=6, extent=EXTENT):
    pitch = extent / (max(rows, cols) - 1)
    return Pattern(rows, cols, pitch, "dark", n, PatternSurface("sphere_cap", RADIUS))


def surface_of(pattern, field=bump):
    """What triangulation would give, without noise."""
    rows, cols, n = pattern.rows, pattern.cols, pattern.points_per_segment
    i, j = np.arange(rows), np.arange(cols)
    part = np.arange(1, n + 1) / (n + 1)
    reference = pattern.corners()
    displacement = field(reference[..., 0], reference[..., 1])
    zero = np.zeros((1, 1, 1))
    along_rows, along_cols = (
        pattern.at(*np.broadcast_arrays(*place))
        for place in (
            (i[:, None, None] + zero, j[:-1, None] + part),
            (i[:-1, None, None] + part, j[:, None] + zero),
        )
    )
    lines = (line + field(line[..., 0], line[..., 1]) for line in (along_rows, along_cols))
    return Surface.from_exact_points(pattern.shape, reference, reference + displacement, *lines)


def without_corner(surface, i, j):
    """The surface with a corner and the virtual markers of its four segments not seen."""
    status, row_status, col_status = (
        a.copy() for a in (surface.status, surface.row_status, surface.col_status)
    )
    status[i, j] = 0
    row_status[i, max(j - 1, 0) : j + 1] = 0
    col_status[max(i - 1, 0) : i + 1, j] = 0
    lost = {
        "displacement": np.where(status[..., None] > 0, surface.displacement, np.nan),
        "position": np.where(status[..., None] > 0, surface.position, np.nan),
        "row_position": np.where(row_status[..., None] > 0, surface.row_position, np.nan),
        "col_position": np.where(col_status[..., None] > 0, surface.col_position, np.nan),
    }
    return replace(surface, status=status, row_status=row_status, col_status=col_status, **lost)


def material(dense):
    return np.meshgrid(dense.grid.x, dense.grid.y)


def errors(dense, field=bump):
    x, y = material(dense)
    return np.linalg.norm(dense.displacement - field(x, y), axis=-1)


@pytest.mark.parametrize("n", [0, 1, 6])
def test_the_error_falls_with_the_fourth_power_of_the_pitch(n):
    """Or nearly, with errors of picometres: a patch of one direction alone has order 2."""
    pitches, usual = [], []
    for corners in (12, 17, 24):
        pattern = pattern_of(corners, corners, n)
        dense = interpolate(surface_of(pattern), EXTENT / 150)
        pitches.append(pattern.pitch)
        inside = (slice(30, -30), slice(30, -30))
        found = errors(dense)[inside]
        usual.append(np.sqrt((found**2).mean()))
    order = np.polyfit(np.log(pitches), np.log(usual), 1)[0]
    assert order > 3.0
    assert found.max() < 0.1e-6


def test_detail_between_the_corners_comes_from_the_virtual_markers():
    """A dent smaller than a checker, on a gridline between two corners: corners do not see it."""
    pattern = pattern_of(12, 12)
    x0 = pattern.at(np.array(6.0), np.array(5.5))

    def dent(x, y):
        share = np.exp(-((x - x0[0]) ** 2 + (y - x0[1]) ** 2) / (0.3 * pattern.pitch) ** 2)
        return np.stack([0 * x, 0 * x, -1e-4 * share], -1)

    dense = interpolate(surface_of(pattern, dent), pattern.pitch / 20)
    assert dense.displacement[..., 2].min() == pytest.approx(-1e-4, rel=0.03)


@pytest.mark.parametrize(("i", "j"), [(5, 7), (0, 4), (9, 11), (1, 1)])
def test_a_lost_marker_spoils_its_neighbourhood_alone(i, j):
    pattern = pattern_of(10, 12, extent=0.0088)
    surface = surface_of(pattern)
    spacing = pattern.pitch / 10
    whole, part = (interpolate(s, spacing) for s in (surface, without_corner(surface, i, j)))
    x, y = material(whole)
    off_x = np.abs(x / pattern.pitch + (pattern.cols - 1) / 2 - j)
    off_y = np.abs(y / pattern.pitch + (pattern.rows - 1) / 2 - i)
    touched = (off_x < 1 - 1e-6) & (off_y < 1 - 1e-6)
    assert (part.status[~touched] == DenseStatus.MEASURED).all()
    assert (part.status[touched] != DenseStatus.MEASURED).all()
    off = np.linalg.norm(part.displacement - whole.displacement, axis=-1)
    # Cubics next to it, along and across, lose a point; the most where the rim is near.
    assert off[~touched].max() < 0.1e-6
    bridged = part.status == DenseStatus.INTERPOLATED
    assert np.nanmax(np.where(bridged, off, np.nan), initial=0) < 2e-6
    # In the rim's corner nothing is beyond.
    missing = part.status == DenseStatus.MISSING
    assert np.isnan(part.displacement[missing]).all()
    assert missing.any() == ((i, j) == (9, 11))


def test_extrapolation_reaches_as_far_as_the_margin_and_is_marked():
    pattern = pattern_of(10, 12, extent=0.0088)
    surface = without_corner(surface_of(pattern), 9, 11)
    for i, j in np.ndindex(3, 3):
        surface = without_corner(surface, 4 + i, 4 + j)
    pitch = pattern.pitch
    margin = 0.6 * pitch
    grid = grid_over(pattern.shape, pitch, pitch / 10, pitch)
    dense = SurfaceInterpolator(pattern.shape, pitch, grid, margin).interpolate(surface)
    x, y = material(dense)
    half_x, half_y = (pattern.cols - 1) / 2 * pitch, (pattern.rows - 1) / 2 * pitch
    beyond = np.maximum(np.abs(x) - half_x, np.abs(y) - half_y)
    status = dense.status
    assert (status[beyond > margin * (1 + 1e-6)] == DenseStatus.MISSING).all()
    rim = (beyond > 1e-9) & (beyond < margin * (1 - 1e-6)) & ~((x > 0) & (y > 0))
    assert (status[rim] == DenseStatus.EXTRAPOLATED).all()
    np.testing.assert_array_equal(status == DenseStatus.MISSING, np.isnan(dense.position[..., 2]))
    hole_x = x / pitch + (pattern.cols - 1) / 2 - 5
    hole_y = y / pitch + (pattern.rows - 1) / 2 - 5
    deep = (np.abs(hole_x) < 1.3) & (np.abs(hole_y) < 1.3)
    assert (status[deep] == DenseStatus.MISSING).all(), "nothing is made up in a hole"
    # Linear beyond the rim through points a pitch apart: half of a second derivative (at most
    # 2 depth / width^2) times margin (margin + pitch).
    most = 8e-4 / 3e-3**2 * margin * (margin + pitch)
    assert np.nanmax(np.where(rim, errors(dense), np.nan)) < most
    tight = SurfaceInterpolator(pattern.shape, pitch, grid, 0.0).interpolate(surface)
    assert (tight.status != DenseStatus.EXTRAPOLATED).all()


def test_no_ringing_at_a_steep_edge():
    """A block pressed in by 0.5 mm, its edge across the checkers and narrower than one."""
    pattern = pattern_of(20, 20)
    worst = 0.0
    for turn in np.radians([0.0, 20.0, 45.0]):
        for shift in np.linspace(0, 1, 9) * pattern.pitch:

            def step(x, y, turn=turn, shift=shift):
                u = x * np.cos(turn) + y * np.sin(turn) - shift
                v = y * np.cos(turn) - x * np.sin(turn)
                inside = np.maximum(np.abs(u), np.abs(v)) - 3e-3
                ramp = np.clip(0.5 - inside / (0.25 * pattern.pitch), 0, 1)
                return np.stack([0 * x, 0 * x, -5e-4 * ramp], -1)

            dense = interpolate(surface_of(pattern, step), pattern.pitch / 8)
            depth = -dense.displacement[..., 2] / 5e-4
            worst = max(worst, depth.max() - 1, -depth.min())
    assert worst < MOST_OVERSHOOT


def test_a_monocular_sensor_has_displacement_without_depth():
    surface = surface_of(pattern_of(9, 9))
    for points in (
        surface.position, surface.displacement, surface.row_position, surface.col_position
    ):  # fmt: skip
        points[..., 2] = np.nan
    dense = interpolate(surface, 3e-4)
    assert (dense.status == DenseStatus.MEASURED).all()
    assert np.isfinite(dense.displacement[..., :2]).all()
    assert np.isnan(dense.displacement[..., 2]).all()
    assert (height_map(dense).status == DenseStatus.MISSING).all()


def test_displacement_is_against_the_reference_that_the_surface_has():
    """A reference off the nominal surface, one of its corners unknown."""
    pattern = pattern_of(12, 12)
    surface = surface_of(pattern)
    shift = np.array([2e-5, -1e-5, 3e-5])
    reference = surface.reference + shift
    reference[4, 4] = np.nan
    displacement = surface.position - reference
    status = np.where(np.isfinite(displacement[..., 0]), 1, 0).astype(np.uint8)
    moved = replace(surface, reference=reference, displacement=displacement, status=status)
    interpolator = SurfaceInterpolator(
        pattern.shape, pattern.pitch, grid_over(pattern.shape, pattern.pitch, 2e-4)
    )
    interpolator.interpolate(surface)
    dense = interpolator.interpolate(moved)
    x, y = material(dense)
    np.testing.assert_allclose(dense.displacement, bump(x, y) - shift, atol=2e-6)
    assert (dense.status != DenseStatus.MISSING).all()


def test_height_over_space_of_a_surface_in_closed_form():
    """Error falls with the square of the spacing; where material went, not where it was."""
    pattern = pattern_of(20, 20)

    def press(x, y):
        return np.stack([0.1 * x + 2e-4, 0 * y, -20.0 * (x**2 + y**2)], -1)

    surface = surface_of(pattern, press)
    worst = []
    for spacing in (4e-4, 2e-4, 1e-4):
        space = SurfaceGrid(41, 41, (0.010, 0.010))
        heights = height_map(interpolate(surface, spacing), space)
        x, y = np.meshgrid(space.x, space.y)
        at_rest = (x - 2e-4) / 1.1
        truth = pattern.surface.height(np.stack([at_rest, y], -1)) - 20.0 * (at_rest**2 + y**2)
        assert (heights.status == DenseStatus.MEASURED).all()
        worst.append(np.abs(heights.height - truth).max())
    assert 3.0 < worst[0] / worst[1] < 5.5
    assert 3.0 < worst[1] / worst[2] < 5.5
    assert worst[-1] < 0.2e-6


@pytest.mark.parametrize(
    ("spacing", "margin"), [(-1e-4, 0.0), (1.0, 0.0), (1e-4, -1e-4), (np.nan, 0.0), (1e-7, 0.0)]
)
def test_lengths_that_make_no_grid_are_errors(spacing, margin):
    with pytest.raises(InputError, match=r"dense surface: found .*, expected"):
        interpolate(surface_of(pattern_of(8, 8)), spacing, margin)


def test_a_surface_of_another_shape_or_without_reference_is_an_error():
    pattern, surface = pattern_of(8, 8), surface_of(pattern_of(8, 8))
    grid = grid_over(pattern.shape, pattern.pitch, 5e-4)
    interpolator = SurfaceInterpolator(pattern.shape, pattern.pitch, grid)
    with pytest.raises(InputError, match=r"surface: found GridShape\(rows=9"):
        interpolator.interpolate(surface_of(pattern_of(9, 8)))
    nowhere = replace(surface, reference=np.full_like(surface.reference, np.nan))
    with pytest.raises(InputError, match="no pitch in the reference"):
        interpolate(nowhere, 5e-4)
