"""What is kept of a recording's grids, and said of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_bringup.recordings.results import ArrayLog, GridFaults, grid_arrays
from cmp_tactile_processing.measured import Grid, GridFault, GridShape

SHAPE = GridShape(4, 5, 2)


def _grid(fault: GridFault, reason: str = "") -> Grid:
    return Grid.missing(SHAPE, reason, fault=fault)


def test_grids_with_and_without_deviations_and_every_fault_go_into_one_file(tmp_path):
    plain = replace(_grid(GridFault.NONE), corner_std=None, row_line_std=None, col_line_std=None)
    known = replace(plain, corner_std=np.full(SHAPE.corners, 0.25), confidence=0.5, followed=True)
    grids = [plain, known, *(_grid(fault) for fault in GridFault)]
    with ArrayLog(tmp_path / "grids.npz") as log:
        for grid in grids:
            log.append(grid_arrays(grid))
    with np.load(tmp_path / "grids.npz", allow_pickle=False) as arrays:
        assert arrays["fault"].tolist() == ["", "", *(fault.value for fault in GridFault)]
        assert arrays["followed"].tolist()[:2] == [False, True]
        assert arrays["confidence"][1] == 0.5
        assert np.isnan(arrays["corner_std"][0]).all()
        assert (arrays["corner_std"][1] == 0.25).all()
        assert arrays["row_line_std"].shape == (len(grids), 4, 4, 2)
        assert arrays["col_line_std"].shape == (len(grids), 3, 5, 2)


@pytest.mark.parametrize("fault", [GridFault.NONE, GridFault.PARTLY_HIDDEN])
def test_a_hidden_part_is_no_reason_for_doubt(fault):
    faults = GridFaults()
    faults.add({"left": _grid(fault, "3 corners not seen"), "right": None})
    assert list(faults.doubts) == []


def test_each_view_reports_how_often_and_the_last_reason():
    faults = GridFaults()
    good = _grid(GridFault.NONE)
    faults.add({"left": good, "right": _grid(GridFault.DARK, "too dark: 3")})
    faults.add({"left": good, "right": _grid(GridFault.MIRRORED, "a mirror image")})
    faults.add({"left": _grid(GridFault.NO_PATTERN, "nothing"), "right": good})
    assert sorted(faults.doubts) == [
        "left view: in 1 of 3 frames no_pattern: nothing",
        "right view: in 2 of 3 frames mirrored: a mirror image",
    ]
