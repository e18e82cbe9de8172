"""Virtual markers in 3-D: gridlines as curves, measured across and interpolated along."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import TriangulationParameters
from cmp_tactile_processing.sensor.parts import PatternSurface, RefractingLayer
from cmp_tactile_processing.stereo.triangulation import common_normal
from cmp_tactile_processing.stereo.virtual_markers import (
    LineNodes,
    Lines3D,
    LineTriangulator,
    SeenLines,
)

PLATE_AND_GEL = (RefractingLayer(-0.0145, 1.49), RefractingLayer(-0.0057, 1.41))
# What curves through corners 0.7 mm apart leave out of a sphere of 27 mm at the pattern's edge.
ATOL_REST_M = 5e-9
# Of presses and drags some checkers wide, at the worst virtual marker.
ATOL_SMOOTH_M = 0.7e-6
# What is left where both views' planes are known exactly: second order in how far they lie from the
# curve, some um.
ATOL_MEASURED_M = 50e-9
# Of a marker that a view puts 0.3 px further along: the gridline bends by so much over 7 um.
ATOL_SLID_M = 20e-9
CORNER_STD_M = 0.5e-6


@dataclass(frozen=True)
class Scene:
    """A deformed pattern: corners and virtual markers in 3-D, as each view sees them."""

    sensor: SensorDescription
    nodes: LineNodes
    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    grids: dict[str, Grid]

    def triangulate(self, **changes: object) -> tuple[Lines3D, Lines3D]:
        scene = replace(self, **changes)
        sensor = scene.sensor
        views = [view for name, view in build_views(sensor).items() if name in scene.grids]
        surface = sensor.pattern.surface if len(views) == 1 else None
        lines = LineTriangulator(sensor.pattern.shape, TriangulationParameters(), surface)
        rows, cols = [], []
        for view in views:
            grid = scene.grids[view.name]
            rows.append(SeenLines.rows(grid, view.ray_bundle(grid.row_lines.reshape(-1, 2))))
            cols.append(SeenLines.cols(grid, view.ray_bundle(grid.col_lines.reshape(-1, 2))))
        return lines.rows(tuple(rows), scene.nodes), lines.cols(tuple(cols), scene.nodes)


def smooth(x, y):
    """Displacement of a press and a drag, some checkers wide."""
    share = np.exp(-((x - 5e-4) ** 2 + (y + 3e-4) ** 2) / 3e-3**2)
    return np.stack([2e-4 * share, 1.5e-4 * share, -5e-4 * share], axis=-1)


def still(x, y):
    return np.zeros((*np.shape(x), 3))


def make_scene(sensor, displacement=still, slide=0.0):
    """slide: of the right view's virtual markers along their gridlines, in shares of a segment."""
    pattern, shape = sensor.pattern, sensor.pattern.shape
    share = np.arange(1, shape.points_per_segment + 1) / (shape.points_per_segment + 1)
    i, j = np.arange(shape.rows), np.arange(shape.cols)

    def points(rows, cols):
        x = (cols - (shape.cols - 1) / 2) * pattern.pitch
        y = (rows - (shape.rows - 1) / 2) * pattern.pitch
        z = surface_height(pattern.surface, x, y)
        return np.stack([x, y, z], axis=-1) + displacement(x, y)

    def along(shift=0.0):
        rows = points(*np.broadcast_arrays(i[:, None, None], j[:-1, None] + share + shift))
        cols = points(*np.broadcast_arrays(i[:-1, None, None] + share + shift, j[:, None]))
        return rows, cols

    corners = points(*np.meshgrid(i, j, indexing="ij"))
    grids = {}
    for name, view in build_views(sensor).items():
        rows, cols = along(slide if name == "right" else 0.0)
        grids[name] = Grid(
            shape=shape,
            corners=view.project(corners),
            corner_status=np.ones(shape.corners, np.uint8),
            row_lines=view.project(rows),
            row_line_status=np.ones(shape.row_lines, np.uint8),
            col_lines=view.project(cols),
            col_line_status=np.ones(shape.col_lines, np.uint8),
            row_line_std=np.full(shape.row_lines, 0.01),
            col_line_std=np.full(shape.col_lines, 0.01),
        )
    covariance = np.broadcast_to(np.eye(3) * CORNER_STD_M**2, (*shape.corners, 3, 3))
    nodes = LineNodes(corners, np.ones(shape.corners, np.uint8), covariance)
    return Scene(sensor, nodes, *along(), grids)


def surface_height(surface, x, y):
    if surface.type == "plane":
        return np.zeros(np.shape(x))
    away = {"sphere_cap": np.hypot(x, y), "cylinder": y if surface.axis == "x" else x}
    return np.sqrt(surface.radius**2 - away[surface.type] ** 2) - surface.radius


def across(error, corners, axis):
    """Length of what of the errors (..., n, 3) lies across the gridline."""
    chord = np.diff(corners, axis=axis)[..., None, :]
    chord = chord / np.linalg.norm(chord, axis=-1, keepdims=True)
    return np.linalg.norm(error - (error * chord).sum(axis=-1, keepdims=True) * chord, axis=-1)


def distance(found, truth):
    return np.linalg.norm(found - truth, axis=-1)


@pytest.fixture(params=["straight", "refracted"])
def rig(request, sensor):
    layers = () if request.param == "straight" else PLATE_AND_GEL
    return replace(sensor, optics=replace(sensor.optics, layers=layers))


@pytest.mark.parametrize(("displacement", "atol"), [(still, ATOL_REST_M), (smooth, ATOL_SMOOTH_M)])
def test_exact_grids_give_exact_markers(rig, displacement, atol):
    """In a rig whose baseline runs along x the depth of rows is not measured between corners."""
    scene = make_scene(rig, displacement)
    rows, cols = scene.triangulate()
    assert distance(rows.position, scene.rows).max() < atol
    assert distance(cols.position, scene.cols).max() < atol
    assert (rows.status == Status.PREDICTED).all()
    assert (cols.status == Status.MEASURED).all()


@pytest.mark.parametrize("displacement", [still, smooth])
def test_where_along_its_line_a_view_puts_a_marker_changes_nothing(rig, displacement):
    """The right view's markers, moved some 0.3 px along: as points they would be um off."""
    straight = make_scene(rig, displacement)
    slid = make_scene(rig, displacement, slide=1 / 55)
    moved = distance(straight.grids["right"].col_lines, slid.grids["right"].col_lines)
    assert moved.mean() > 0.3
    for a, b in zip(straight.triangulate(), slid.triangulate(), strict=True):
        np.testing.assert_allclose(a.position, b.position, atol=ATOL_SLID_M, rtol=0)
        np.testing.assert_array_equal(a.status, b.status)
    views = build_views(rig)
    for key, truth in (("row_lines", straight.rows), ("col_lines", straight.cols)):
        rays = [views[view].rays(getattr(slid.grids[view], key)) for view in ("left", "right")]
        assert distance(common_normal(*rays[0], *rays[1])[0], truth).mean() > 4e-6


def test_a_bend_between_corners_is_measured_where_both_views_tell(rig):
    """A groove along x between two rows, which no corner shows: columns run across it."""

    def groove(x, y):
        depth = 5e-6 * np.exp(-((y / (0.25 * rig.pattern.pitch)) ** 2))
        return np.stack([0 * x, 0 * x, -depth], axis=-1)

    scene, flat = make_scene(rig, groove), make_scene(rig)
    _, cols = scene.triangulate()
    assert distance(scene.nodes.position, flat.nodes.position).max() < 0.1e-6
    assert distance(scene.cols, flat.cols).max() > 4e-6
    np.testing.assert_allclose(cols.position, scene.cols, atol=ATOL_MEASURED_M, rtol=0)
    assert (cols.status == Status.MEASURED).all()


@pytest.mark.parametrize("blind", ["left", "right", ""])
def test_a_groove_that_neither_view_measures_shows_in_the_std(rig, blind):
    """A groove along y between two columns: rows run across it, and along the baseline."""
    pitch = rig.pattern.pitch

    def groove(x, y):
        depth = 0.05 * pitch * np.exp(-((x / (0.25 * pitch)) ** 2))
        return np.stack([0 * x, 0 * x, -depth], axis=-1)

    scene = make_scene(rig, groove)
    if blind:
        scene.grids[blind].row_line_status[:] = Status.MISSING
    rows, _ = scene.triangulate()
    middle = rows.std.shape[1] // 2
    error = distance(rows.position, scene.rows)[:, middle]
    assert error.max() > 0.01 * pitch
    # One groove is one draw: its depth is within two deviations with 95 %.
    assert np.sqrt(np.mean((error / rows.std[:, middle]) ** 2)) < 2.0
    assert np.median(rows.std[:, middle]) > 10 * np.median(rows.std[:, : middle - 3])


def test_the_std_of_a_bow_grows_from_the_corners_to_its_middle(rig):
    """A groove whose section is a parabola: errors, and in the main their std, follow it."""
    pitch = rig.pattern.pitch

    def groove(x, y):
        depth = 0.05 * pitch * np.maximum(1 - (2 * x / pitch) ** 2, 0)
        return np.stack([0 * x, 0 * x, -depth], axis=-1)

    rows, _ = make_scene(rig, groove).triangulate()
    std = np.median(rows.std[:, rows.std.shape[1] // 2], axis=0)
    share = np.arange(1, len(std) + 1) / (len(std) + 1)
    np.testing.assert_allclose(std / std.max(), 4 * share * (1 - share), atol=0.25)


def with_noise(scene):
    """The scene with the noise that its deviations state, in the corners and in all pixels."""
    rng = np.random.default_rng(5)
    corners = scene.nodes.position + rng.normal(0, CORNER_STD_M, scene.nodes.position.shape)
    grids = {
        name: replace(
            grid,
            row_lines=grid.row_lines + rng.normal(0, 0.01, grid.row_lines.shape),
            col_lines=grid.col_lines + rng.normal(0, 0.01, grid.col_lines.shape),
        )
        for name, grid in scene.grids.items()
    }
    return replace(scene, grids=grids, nodes=scene.nodes._replace(position=corners))


def test_errors_are_as_large_as_their_std_says(rig):
    """Errors over std are those of one to two normal numbers."""
    scene = make_scene(rig, smooth)
    rows, cols = with_noise(scene).triangulate()
    for found, truth, axis in ((rows, scene.rows, 1), (cols, scene.cols, 0)):
        ratio = across(found.position - truth, scene.nodes.position, axis) / found.std
        # std is the larger of two, and does not count on both sources being independent.
        assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.2
        assert np.quantile(ratio, 0.99) < 3.0


def test_status_follows_what_the_views_saw(sensor):
    scene = make_scene(sensor, smooth)
    left = scene.grids["left"]
    status = left.col_line_status.copy()
    status[3, 4], status[5, 6] = Status.PREDICTED, Status.MISSING
    right = scene.grids["right"]
    neither = right.col_line_status.copy()
    neither[5, 6, 0] = Status.MISSING
    grids = {
        "left": replace(left, col_line_status=status),
        "right": replace(right, col_line_status=neither),
    }
    _, cols = scene.triangulate(grids=grids)
    assert (cols.status[3, 4] == Status.PREDICTED).all()
    assert cols.status[5, 6].tolist() == [Status.MISSING] + [Status.PREDICTED] * 5
    assert np.isnan(cols.position[5, 6, 0]).all()
    assert np.isnan(cols.std[5, 6, 0])
    assert np.count_nonzero(cols.status != Status.MEASURED) == 12
    np.testing.assert_allclose(cols.position[3:5], scene.cols[3:5], atol=ATOL_SMOOTH_M, rtol=0)


@pytest.mark.parametrize(("degrees", "status"), [(20, Status.PREDICTED), (40, Status.MEASURED)])
def test_gridlines_are_measured_from_30_degrees_to_the_epipolar_plane_on(sensor, degrees, status):
    """In a gel that is turned about its normal its rows make that angle with the baseline."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    optics = replace(sensor.optics, T_camera_gel=sensor.optics.T_camera_gel @ turn)
    rows, cols = make_scene(replace(sensor, optics=optics)).triangulate()
    assert (rows.status == status).all()
    assert (cols.status == Status.MEASURED).all()


def test_views_that_contradict_each_other_do_not_make_up_a_depth(sensor):
    """A shadow shifts a segment of a row by a pixel in one view: its planes meet mm away."""
    scene = make_scene(sensor)
    right = scene.grids["right"]
    lines = right.row_lines.copy()
    lines[2, 5, :, 1] += 1.0
    grids = {**scene.grids, "right": replace(right, row_lines=lines)}
    found, _ = scene.triangulate(grids=grids)
    error = distance(found.position, scene.rows)
    # A pixel is 30 um on the gel; 0.1 segments of 0.7 mm are the most that is believed.
    assert error[2, 5].max() < 75e-6
    assert (found.std[2, 5] > 0.3 * error[2, 5]).all()
    error[2, 5] = 0
    assert error.max() < ATOL_REST_M


def test_missing_corners_are_bridged_and_never_extrapolated(sensor):
    """One missing corner is bridged; two in a row, or the last of a gridline, are not."""
    scene = make_scene(sensor, smooth)
    status = scene.nodes.status.copy()
    lost = [(4, 4), (10, 9), (10, 10), (12, 0)]
    for corner in lost:
        status[corner] = Status.MISSING
    position = np.where(status[..., None] == Status.MISSING, np.nan, scene.nodes.position)
    nodes = LineNodes(position, status, scene.nodes.covariance)
    whole, _ = scene.triangulate()
    rows, cols = scene.triangulate(nodes=nodes)
    gone = np.zeros(rows.status.shape[:2], np.bool_)
    gone[10, 8:11] = gone[12, 0] = True
    np.testing.assert_array_equal(rows.status == Status.MISSING, np.repeat(gone[..., None], 6, 2))
    np.testing.assert_array_equal(np.isnan(rows.position).any(axis=-1), rows.status == 0)
    assert (rows.std[4, 3:5, 2] > whole.std[4, 3:5, 2]).all()
    seen = rows.status != Status.MISSING
    assert distance(rows.position, scene.rows)[seen].max() < 5 * ATOL_SMOOTH_M
    # Each of these columns lacks one corner at most, (12, 0) in the middle of its own.
    assert (cols.status == Status.MEASURED).all()
    assert distance(cols.position, scene.cols).max() < 5 * ATOL_SMOOTH_M
    # What was missing in a frame leaves nothing behind for the next one.
    lines = LineTriangulator(sensor.pattern.shape, TriangulationParameters())
    views = build_views(sensor)
    seen_rows = tuple(
        SeenLines.rows(grid, views[name].ray_bundle(grid.row_lines.reshape(-1, 2)))
        for name, grid in scene.grids.items()
    )
    lines.rows(seen_rows, nodes)
    np.testing.assert_array_equal(lines.rows(seen_rows, scene.nodes).position, whole.position)


SURFACES = {
    "plane": PatternSurface(),
    "sphere": PatternSurface("sphere_cap", 0.027),
    "cylinder x": PatternSurface("cylinder", 0.02, "x"),
    "cylinder y": PatternSurface("cylinder", 0.02, "y"),
}


def one_view_on(sensor, surface):
    return replace(
        sensor,
        pattern=replace(sensor.pattern, surface=surface),
        optics=replace(sensor.optics, type="monocular"),
        views={"right": sensor.views["right"]},
    )


def within(surface, x, y, dx, dy):
    """Displacement (..., 3) that moves points (x, y) of a surface along it."""
    dz = surface_height(surface, x + dx, y + dy) - surface_height(surface, x, y)
    return np.stack([dx, dy, dz], axis=-1)


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_one_view_and_a_known_surface(sensor, surface):
    """Markers moved within the surface, seen elsewhere along their gridlines than they are."""

    def drag(x, y):
        share = np.exp(-(x**2 + y**2) / 3e-3**2)
        return within(surface, x, y, 2e-4 * share, -1e-4 * share)

    scene = make_scene(one_view_on(sensor, surface), drag, slide=1 / 55)
    covariance = np.array(scene.nodes.covariance)
    covariance[..., 2, :] = covariance[..., :, 2] = np.nan
    found = scene.triangulate(nodes=scene.nodes._replace(covariance=covariance))
    for lines, truth in zip(found, (scene.rows, scene.cols), strict=True):
        np.testing.assert_allclose(lines.position, truth, atol=ATOL_SMOOTH_M, rtol=0)
        assert (lines.status == Status.MEASURED).all()
        assert lines.std.max() < 2 * CORNER_STD_M


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_one_view_measures_a_bend_between_corners_along_the_surface(sensor, surface):
    """Gridlines that swing by 5 um from corner to corner, which no corner shows."""
    pattern = sensor.pattern

    def swing(x, y):
        of_rows = np.sin(np.pi * (x / pattern.pitch + (pattern.cols - 1) / 2)) ** 2
        of_cols = np.sin(np.pi * (y / pattern.pitch + (pattern.rows - 1) / 2)) ** 2
        return within(surface, x, y, 5e-6 * of_cols, 5e-6 * of_rows)

    scene = make_scene(one_view_on(sensor, surface), swing)
    rows, cols = scene.triangulate()
    corners = scene.nodes.position
    assert across(rows.position - scene.rows, corners, 1).max() < ATOL_MEASURED_M
    assert across(cols.position - scene.cols, corners, 0).max() < ATOL_MEASURED_M


def test_errors_of_one_view_are_as_large_as_their_std_says(sensor):
    """On a plane there is one direction across a gridline."""
    flat = make_scene(one_view_on(sensor, PatternSurface()))
    covariance = np.array(flat.nodes.covariance)
    covariance[..., 2, :] = covariance[..., :, 2] = np.nan
    scene = with_noise(replace(flat, nodes=flat.nodes._replace(covariance=covariance)))
    scene.nodes.position[..., 2] = 0.0
    rows, cols = scene.triangulate()
    for found, truth, axis in ((rows, flat.rows, 1), (cols, flat.cols, 0)):
        ratio = across(found.position - truth, flat.nodes.position, axis) / found.std
        # std does not count on both sources being independent.
        assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.0
