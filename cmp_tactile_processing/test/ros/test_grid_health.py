"""A second of grids becomes a level, a reason and figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.measured.grid import Grid, GridFault, GridShape, Status
from cmp_tactile_processing.ros.diagnostics.health import FAULT_LEVELS, GridHealth
from cmp_tactile_processing.ros.diagnostics.stage import StageDiagnostics

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
        "fault": "",
        "frames with a fault": "0 of 4",
    }


def test_the_worst_fault_of_a_period_is_told_though_good_frames_follow():
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


def test_without_grids_the_figures_are_unknown():
    figures = GridHealth().close_period()[2]
    assert figures["followed"] == figures["confidence"] == figures["tracked fraction"] == "nan"


@pytest.mark.parametrize("fault", [GridFault.DARK, GridFault.MIRRORED, GridFault.PARTLY_HIDDEN])
def test_the_level_reaches_the_report(fault):
    diagnostics = StageDiagnostics()
    health = GridHealth()
    health.add(_faulty(fault))
    diagnostics.note_level, diagnostics.note, _ = health.close_period()
    diagnostics.frame_in()
    status = diagnostics.status("rig/tracker", "rig")
    assert (status.level, status.message) == (FAULT_LEVELS[fault], f"because of {fault.value}")


def test_a_wrong_description_is_told_before_bad_frames():
    diagnostics = StageDiagnostics()
    diagnostics.note_level, diagnostics.note = DiagnosticStatus.ERROR, "a mirror image"
    diagnostics.frame_in()
    diagnostics.bad_frame("too short")
    status = diagnostics.status("rig/tracker", "rig")
    assert status.level == DiagnosticStatus.ERROR
    assert status.message == "a mirror image; 1 bad frames, last: too short"
