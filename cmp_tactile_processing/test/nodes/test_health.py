"""A second of grids or force fields becomes a level, a text and figures."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from dataclasses import replace

import numpy as np
from made_forces import made_field

from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.force.advice import ADVICE, flag_names
from cmp_tactile_processing.measured import ForceFlag, Grid, GridFault, GridShape, Status
from cmp_tactile_processing.nodes.health import FAULT_LEVELS, WARNED_OF, ForceHealth, GridHealth

pytestmark = pytest.mark.ros

SHAPE = GridShape(4, 5, 1)


def _good() -> Grid:
    grid = Grid.missing(SHAPE, "", fault=GridFault.NONE)
    return replace(grid, corner_status=np.full(SHAPE.corners, Status.MEASURED, np.uint8))


def _faulty(fault: GridFault) -> Grid:
    return Grid.missing(SHAPE, f"because of {fault.value}", fault=fault)


def test_every_fault_has_a_level():
    assert set(FAULT_LEVELS) == set(GridFault)


def test_the_worst_fault_of_a_period_is_reported_though_good_frames_follow():
    health = GridHealth()
    for grid in (
        _faulty(GridFault.PARTLY_HIDDEN),
        _faulty(GridFault.MIRRORED),
        _faulty(GridFault.DARK),
        _good(),
    ):
        health.add(grid)
    found, figures = health.close_period()
    assert found == Finding(Severity.ERROR, "because of mirrored")
    assert figures["fault"] == "mirrored"
    assert figures["frames with a fault"] == "3 of 4"
    health.add(_good())
    assert health.close_period()[0] == Finding(Severity.OK, "")


def test_every_flag_has_its_advice():
    assert set(ADVICE) == {flag for flag in ForceFlag if flag}
    assert flag_names(ForceFlag.NO_DEPTH | ForceFlag.AT_BORDER) == "at_border, no_depth"
    assert flag_names(ForceFlag(0x8000 | ForceFlag.POOR_FIT)) == "poor_fit"


@pytest.mark.parametrize("flag", ADVICE)
def test_a_flag_is_reported_with_advice_and_warned_of_where_it_spoils_the_force(flag):
    health = ForceHealth()
    for flags in (flag, flag, ForceFlag.NONE):
        health.add(made_field(rows=2, cols=2, flags=flags))
    found, figures = health.close_period()
    assert found.text == ADVICE[flag]
    assert figures["flags"] == flag.name.lower()
    assert found.severity == (Severity.WARNING if flag in WARNED_OF else Severity.OK)


def test_a_flag_of_few_frames_is_not_reported():
    health = ForceHealth()
    for flags in (ForceFlag.POOR_FIT, ForceFlag.NONE, ForceFlag.NONE):
        health.add(made_field(rows=2, cols=2, flags=flags))
    assert health.close_period()[0] == Finding(Severity.OK, "")
