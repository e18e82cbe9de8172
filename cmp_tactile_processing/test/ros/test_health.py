"""A second of grids or force fields becomes a level, a text and figures, without flicker."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from dataclasses import replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from made_forces import made_field

from cmp_tactile_processing.force.advice import ADVICE, flag_names
from cmp_tactile_processing.measured import (
    ForceField,
    ForceFlag,
    Grid,
    GridFault,
    GridShape,
    Status,
)
from cmp_tactile_processing.ros.diagnostics.health import (
    FAULT_LEVELS,
    WARNED_OF,
    ForceHealth,
    GridHealth,
)

pytestmark = pytest.mark.ros

SHAPE = GridShape(4, 5, 1)


def _good(confidence: float = 1.0, *, followed: bool = True) -> Grid:
    grid = Grid.missing(SHAPE, "", fault=GridFault.NONE)
    status = np.full(SHAPE.corners, Status.MEASURED, np.uint8)
    return replace(grid, corner_status=status, confidence=confidence, followed=followed)


def _faulty(fault: GridFault) -> Grid:
    return Grid.missing(SHAPE, f"because of {fault.value}", fault=fault)


def test_every_fault_has_a_level():
    assert set(FAULT_LEVELS) == set(GridFault)


def test_good_grids_give_no_text():
    health = GridHealth()
    for grid in (_good(0.9), _good(0.8), _good(np.nan), _good(0.95, followed=False)):
        health.add(grid)
    level, text, figures = health.close_period()
    assert (level, text) == (DiagnosticStatus.OK, "")
    assert figures == {
        "tracked fraction": "1.0000",
        "confidence": "0.800",
        "followed": "0.75",
        "numbering": "absolute",
        "fault": "",
        "frames with a fault": "0 of 4",
    }


def test_the_worst_fault_of_a_period_is_reported_though_good_frames_follow():
    health = GridHealth()
    for grid in (
        _faulty(GridFault.PARTLY_HIDDEN),
        _faulty(GridFault.MIRRORED),
        _faulty(GridFault.DARK),
        _good(),
    ):
        health.add(grid)
    level, text, figures = health.close_period()
    assert (level, text) == (DiagnosticStatus.ERROR, "because of mirrored")
    assert figures["fault"] == "mirrored"
    assert figures["frames with a fault"] == "3 of 4"
    assert figures["confidence"] == "0.000"
    health.add(_good())
    assert health.close_period()[:2] == (DiagnosticStatus.OK, "")


def _field(flags: ForceFlag = ForceFlag.NONE) -> ForceField:
    return made_field(
        rows=2,
        cols=2,
        valid_fraction=0.75,
        wrench_covariance=np.diag([1e-4, 4e-4, 9e-4, 1e-8, 4e-8, 9e-8]),
        flags=flags,
        noise_scale=1.25,
        corrected=True,
    )


def _period(health: ForceHealth, flag: ForceFlag, count: int, of: int) -> tuple[bytes, str, str]:
    for k in range(of):
        health.add(_field(flag if k < count else ForceFlag.NONE))
    level, text, figures = health.close_period()
    return level, text, figures["flags"]


def test_every_flag_has_its_advice():
    assert set(ADVICE) == {flag for flag in ForceFlag if flag}
    assert flag_names(ForceFlag.NO_DEPTH | ForceFlag.AT_BORDER) == "at_border, no_depth"
    assert flag_names(ForceFlag(0x8000 | ForceFlag.POOR_FIT)) == "poor_fit"


@pytest.mark.parametrize("flag", ADVICE)
def test_a_flag_is_reported_with_advice_and_warned_of_where_it_spoils_the_force(flag):
    level, text, names = _period(ForceHealth(), flag, 20, 20)
    assert text == ADVICE[flag]
    assert names == flag.name.lower()
    warned = {
        ForceFlag.FEW_MARKERS,
        ForceFlag.NOT_CONVERGED,
        ForceFlag.POOR_FIT,
        ForceFlag.IMPLAUSIBLE,
        ForceFlag.ZERO_DOUBTFUL,
    }
    assert level == (DiagnosticStatus.WARN if flag in warned else DiagnosticStatus.OK)
    assert (flag in WARNED_OF) == (flag in warned)


def test_a_flag_that_comes_and_goes_does_not_make_the_diagnostics_flicker():
    health, flag = ForceHealth(), ForceFlag.POOR_FIT
    shares = [
        (1, ""),
        (9, ""),
        (12, "poor_fit"),
        (3, "poor_fit"),
        (2, "poor_fit"),
        (1, ""),
        (9, ""),
    ]
    reported = [_period(health, flag, count, 20)[2] for count, _ in shares]
    assert reported == [name for _, name in shares]
