"""What `cmp_tactile process` keeps of force fields and grids, and says of them."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from made_forces import made_contact, made_field

from cmp_tactile_bringup.recordings.results import (
    COLUMNS,
    ArrayLog,
    ForceFlags,
    GridFaults,
    force_arrays,
    grid_arrays,
    table_row,
)
from cmp_tactile_processing.measured import (
    ForceField,
    ForceFlag,
    Grid,
    GridFault,
    GridShape,
    SlipEstimate,
    SlipState,
)


@pytest.fixture
def field() -> ForceField:
    """A field of 2 x 4 nodes with two contacts."""
    contact = np.array([1, 0, 0, 1, 1, 0, 0, 0], np.bool_)
    slip = SlipEstimate(SlipState.FULL, 1.0, 0.5, 0.52, 0.03)
    return made_field(
        rows=2,
        cols=4,
        force=np.ones((8, 3)),
        contact=contact,
        wrench=np.array([1.0, -2.0, -3.0, 4e-3, 5e-3, 6e-3]),
        contact_area=2e-5,
        centre_of_pressure=np.zeros(3),
        slip_state=slip.state,
        wrench_covariance=np.diag([1e-4, 4e-4, 9e-4, 1e-8, 4e-8, 9e-8]),
        contacts=(made_contact([3]), made_contact([0, 4])),
        slip=slip,
        flags=ForceFlag.AT_BORDER | ForceFlag.POOR_FIT,
    )


def test_the_table_is_read_back_as_numbers(field):
    file = io.StringIO()
    csv.writer(file).writerows([COLUMNS, table_row(1_700_000_000_123_456_789, 0.123456789, field)])
    file.seek(0)
    row = np.genfromtxt(file, delimiter=",", names=True)
    assert set(row.dtype.names) == set(COLUMNS)
    expected = {
        "fz_N": -3.0,
        "mx_Nm": 4e-3,
        "contact_area_m2": 2e-5,
        "std_fx_N": 0.01,
        "std_fz_N": 0.03,
        "std_mz_Nm": 3e-4,
        "contacts": 2,
        "slip_state": 4,
        "friction_coefficient": 0.52,
        "friction_std": 0.03,
        "flags": 130,
        "time_s": 0.123456789,
    }
    for name, value in expected.items():
        assert row[name] == pytest.approx(value), name
    file.seek(0)
    (named,) = csv.DictReader(file)
    assert (named["slip"], named["flag_names"]) == ("full", "at_border poor_fit")


def test_nodes_carry_the_number_of_their_contact(field):
    assert force_arrays(field)["contact_number"].tolist() == [2, 0, 0, 1, 2, 0, 0, 0]


def test_unknown_deviations_are_nan_in_the_shape_of_known_ones(field):
    """A log takes rows of one shape only."""
    known = replace(field, force_std=np.full((8, 3), 0.5))
    one, other = force_arrays(field), force_arrays(known)
    assert {k: (v.shape, v.dtype) for k, v in one.items()} == {
        k: (v.shape, v.dtype) for k, v in other.items()
    }
    assert np.isnan(one["force_std"]).all()


def test_each_flag_is_counted_and_a_recording_is_not_to_be_zeroed(field):
    """First the flags that forbid to use a force, however late they come."""
    flags = ForceFlags()
    flags.add(replace(field, flags=ForceFlag.NO_DEPTH | ForceFlag.HIDDEN_CONTACT))
    flags.add(replace(field, flags=ForceFlag.NO_DEPTH | ForceFlag.BEYOND_MARKERS))
    flags.add(replace(field, flags=ForceFlag.POOR_FIT))
    begins = [found.text.partition(";")[0] for found in flags.findings]
    assert "2 of 3 frames" in begins[0]
    assert [" ".join(begin.split()[:6]) for begin in begins[1:3]] == [
        "in 1 of 3 frames beyond_markers:",
        "in 1 of 3 frames poor_fit:",
    ]
    assert [doubt.split(":")[0] for doubt in begins[3:]] == [
        "in 1 of 3 frames hidden_contact",
        "in 2 of 3 frames no_depth",
    ]
    fit = list(flags.findings)[2].text
    assert "--reference first-N" in fit
    assert "zero again" not in fit


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
    assert list(faults.findings) == []


def test_each_view_reports_how_often_and_the_last_reason():
    faults = GridFaults()
    good = _grid(GridFault.NONE)
    faults.add({"left": good, "right": _grid(GridFault.DARK, "too dark: 3")})
    faults.add({"left": good, "right": _grid(GridFault.MIRRORED, "a mirror image")})
    faults.add({"left": _grid(GridFault.NO_PATTERN, "nothing"), "right": good})
    assert sorted(found.text for found in faults.findings) == [
        "all 3 frames have a fault",
        "left view: in 1 of 3 frames no_pattern: nothing",
        "right view: in 2 of 3 frames mirrored: a mirror image",
    ]
