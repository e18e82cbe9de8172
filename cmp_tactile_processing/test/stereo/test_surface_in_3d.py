"""Split, triangulation and displacement against truth and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import FrameError, InputError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Status, ViewPlacement
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.stereo.triangulation import common_normal
from cmp_tactile_processing.surface.displacement import Reference

# The sample frames are of sharp presses and drags: curves between their corners are this good.
MEAN_CURVE_M, LARGEST_CURVE_M = 0.8e-6, 12e-6


def exact_grids(sensor, truth):
    """Grids as a perfect tracker would give them."""
    rows, cols, n = sensor.pattern.rows, sensor.pattern.cols, sensor.pattern.points_per_segment
    missing, grids = Grid.missing(sensor.pattern.shape, ""), {}
    for name, view in StereoRig(sensor).views.items():
        # The lines hold the corners, too.
        row_lines, col_lines = (
            view.placement.from_frame(truth[f"{key}_{name}_px"])[:, :-1]
            for key in ("row_lines", "col_lines")
        )
        col_lines = col_lines.reshape(cols, rows - 1, n + 1, 2)[:, :, 1:].swapaxes(0, 1)
        grids[name] = replace(
            missing,
            corners=view.placement.from_frame(truth[f"corners_{name}_px"]),
            corner_status=np.ones_like(missing.corner_status),
            row_lines=row_lines.reshape(rows, cols - 1, n + 1, 2)[:, :, 1:].copy(),
            row_line_status=np.ones_like(missing.row_line_status),
            col_lines=col_lines.copy(),
            col_line_status=np.ones_like(missing.col_line_status),
        )
    return grids


@pytest.mark.parametrize("name", ["rest", "slide", "press", "twist", "bumps"])
def test_triangulation_of_exact_points_is_exact(sensor, stills, name):
    """Virtual markers are equally spaced in material: their rays meet, and the curves are there."""
    truth, rig = stills[name].truth, StereoRig(sensor)
    grids = exact_grids(sensor, truth)
    markers = rig.triangulate(grids["left"], grids["right"])
    # Pixel truth to 1e-12 px: nanometres are far above what remains.
    np.testing.assert_allclose(markers.position, truth["corners_m"], atol=1e-9, rtol=0)
    assert (markers.status == Status.MEASURED).all()
    assert markers.ray_gap.max() < 1e-9
    for found, key in ((markers.row_position, "row_lines"), (markers.col_position, "col_lines")):
        rays = [view.rays(getattr(grids[name], key)) for name, view in rig.views.items()]
        error = np.linalg.norm(found - common_normal(*rays[0], *rays[1])[0], axis=-1)
        assert error.mean() < MEAN_CURVE_M
        assert error.max() < LARGEST_CURVE_M


@pytest.mark.parametrize("field", ["corners", "corner_status", "row_lines", "col_line_std"])
def test_a_grid_whose_arrays_are_not_of_its_shape_is_refused(sensor, field):
    """Compiled loops check no bounds: they would write beyond their memory."""
    grid = Grid.missing(sensor.pattern.shape, "")
    wrong = replace(grid, **{field: np.repeat(getattr(grid, field), 2, axis=0)})
    with pytest.raises(InputError, match=f"right grid: {field}: found .*, expected"):
        StereoRig(sensor).triangulate(grid, wrong)


def test_a_frame_that_does_not_hold_the_view_is_refused():
    with pytest.raises(FrameError, match=r"found 10 x 6 px, expected at least 13 x 3"):
        split_frame(np.zeros((6, 10), np.uint8), ViewPlacement(9, 0, 4, 3, flipped=False))


def test_reference_of_another_size_is_refused(sensor):
    missing = Grid.missing(sensor.pattern.shape, "")
    markers = StereoRig(sensor).triangulate(missing, missing)
    narrow = Reference.nominal(sensor).position[:, 1:]
    with pytest.raises(InputError, match=r"found \(20, 19, 3\), expected \(20, 20, 3\)"):
        Reference(narrow, np.zeros((*narrow.shape, 3))).surface(markers)


def test_grids_that_do_not_belong_are_refused(sensor, stills, plane_rig):
    grids = exact_grids(sensor, stills["rest"].truth)
    with pytest.raises(InputError, match="right grid: found none"):
        StereoRig(sensor).triangulate(grids["left"], None)
    with pytest.raises(InputError, match=r"left grid: found GridShape\(rows=20.*expected .*=9"):
        StereoRig(plane_rig(9, 9)).triangulate(grids["left"], grids["right"])
