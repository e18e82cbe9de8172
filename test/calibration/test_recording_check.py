"""Check of recordings: what holds is accepted, what has moved since is reported."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_rigs import gel_frames, gel_grids, one_view_rig, two_view_rig
from scipy.spatial.transform import Rotation

from cmp_tactile_bringup.calibration.practice import changed_rig
from cmp_tactile_processing.calibration.check import (
    CheckParameters,
    check_grids,
    check_recording,
    rigid_drift,
)
from cmp_tactile_processing.errors import CalibrationError, FrameError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.parts import CalibrationRecord, Mirror
from hard_frames.deformation import Zone

PRESS = (Zone(1e-3, 0.0, 4e-3, depth=8e-4, spread=0.08),)


def recording(take, rig, contact=PRESS):
    """Three frames at rest, two in contact, two at rest."""
    parts = [take(rig, 3), take(rig, 2, contact, seed=1), take(rig, 2, seed=2)]
    return {name: [grid for part in parts for grid in part[name]] for name in rig.views}


def figure(report, name):
    return next(item for item in report.figures if item.name == name)


@pytest.mark.parametrize("kind", ["mirrors", "two cameras", "one view"])
def test_a_good_calibration_holds(gel_rig, kind):
    make = {"mirrors": lambda rig: rig, "two cameras": two_view_rig, "one view": one_view_rig}
    rig = make[kind](gel_rig)
    report = check_grids(rig, recording(gel_grids, rig))
    assert report.accepted
    assert report.findings == ()
    assert report.verdict.startswith("The calibration is good")
    assert report.frames == 7
    assert report.rest_frames == (0, 1, 2, 5, 6)
    names = {item.name for item in report.figures}
    assert ("ray gap" in names) == (kind != "one view")
    assert {"shift", "turn", "growth", "shape at rest", "corners at rest"} <= names
    assert all(np.isfinite([item.value, item.limit]).all() for item in report.figures)


def test_corners_at_rest_are_held_against_what_the_calibration_promised(gel_rig):
    """A calibration of 0.5 px leaves three times that at rest; one of 0.001 px the usual limit."""
    limits = []
    for promised_px in (0.5, 1e-3):
        record = CalibrationRecord("gel", "2026-07-01T12:00:00Z", 1, promised_px)
        rig = replace(gel_rig, calibration=record)
        report = check_grids(rig, gel_grids(rig, 2))
        limits.append(figure(report, "corners at rest").limit)
    assert limits == [1.5, CheckParameters().rest_reprojection]


def test_the_epipolar_error_is_the_distance_across_epipolar_lines(gel_rig):
    """In a camera that is rolled by 40 degrees they are oblique; pixels are off by 1 px along y."""
    rig = two_view_rig(gel_rig)
    roll = np.eye(4)
    roll[:3, :3] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    right = replace(rig.views["right"], T_view_gel=roll @ rig.views["right"].T_view_gel)
    rig = replace(rig, views={**rig.views, "right": right})
    grids = gel_grids(rig, 2)
    grids["right"] = [replace(grid, corners=grid.corners + (0, 1)) for grid in grids["right"]]
    found = figure(check_grids(rig, grids), "epipolar error")
    left, right = build_views(rig).values()
    points = rig.pattern.corners()
    along = right.project(points + 1e-4 * left.rays(left.project(points))[1])
    along -= right.project(points)
    expected = np.median(np.abs(along[..., 0]) / np.linalg.norm(along, axis=-1))
    assert found.median == pytest.approx(expected, rel=0.05)


def test_an_uncalibrated_sensor_is_refused(gel_rig):
    report = check_grids(gel_rig, recording(gel_grids, changed_rig(gel_rig, 1)))
    assert not report.accepted
    assert not figure(report, "epipolar error").kept
    assert report.verdict.startswith("Do not measure with this calibration")
    assert any("calibrate again" in item.advice for item in report.findings)


def test_a_gel_that_was_remounted_is_reported(gel_rig):
    """The views agree as before; the gel at rest lies turned by 20 mrad and 0.2 mm away."""
    moved = changed_rig(gel_rig, 5, turn=0.02, shift=2e-4).optics
    report = check_grids(gel_rig, recording(gel_grids, replace(gel_rig, optics=moved)))
    assert not report.accepted
    assert figure(report, "ray gap").kept
    assert figure(report, "turn").value == pytest.approx(0.02, rel=0.01)
    assert figure(report, "shift").value == pytest.approx(2e-4, rel=0.02)
    assert figure(report, "growth").kept
    assert figure(report, "shape at rest").kept
    assert any(item.text.startswith("Shift: found 200 um") for item in report.findings)


def test_a_mirror_that_turned_is_reported(gel_rig):
    """By a quarter of a degree."""
    right = gel_rig.views["right"]
    assert right.mirror is not None
    normal = Rotation.from_rotvec([0.0, 0.004, 0.0]).apply(right.mirror.normal)
    turned = replace(right, mirror=Mirror(normal, right.mirror.distance))
    rig = replace(gel_rig, views={"left": gel_rig.views["left"], "right": turned})
    report = check_grids(gel_rig, recording(gel_grids, rig))
    assert not report.accepted
    assert any("mirror has moved" in item.advice for item in report.findings)


def test_a_worn_gel_is_reported(gel_rig):
    """A dent of 80 um that stays, so that no contact is seen in it."""
    dent = (Zone(2e-3, 1e-3, 2e-3, depth=8e-5),)
    report = check_grids(gel_rig, gel_grids(gel_rig, deformation=dent))
    assert report.rest_frames == tuple(range(8))
    assert not figure(report, "shape at rest").kept
    assert not report.accepted


def test_contact_alone_shows_no_drift(gel_rig):
    """The views still agree; one view alone has nothing else to be compared with."""
    report = check_grids(gel_rig, gel_grids(gel_rig, deformation=PRESS))
    assert report.accepted
    assert report.drift is None
    assert report.findings[0].text.startswith("No two consecutive frames")
    rig = one_view_rig(gel_rig)
    assert not check_grids(rig, gel_grids(rig, deformation=PRESS)).accepted


def test_a_hidden_pattern_is_reported(gel_rig):
    grids = gel_grids(gel_rig)
    lost = Grid.missing(gel_rig.pattern.shape, "too dark")
    grids["left"] = [*grids["left"][:4], lost, lost, lost, lost]
    report = check_grids(gel_rig, grids)
    assert figure(report, "markers measured").value == 0.5
    assert not report.accepted
    grids["left"] = [lost] * 8
    with pytest.raises(CalibrationError, match=r"no marker in any of 8 frames .left: too dark"):
        check_grids(gel_rig, grids)


def test_from_images(gel_rig):
    reported = []
    frames = gel_frames(gel_rig, 3)
    report = check_recording(gel_rig, frames, lambda *progress: reported.append(progress))
    assert report.accepted
    assert report.rest_frames == (0, 1, 2)
    assert reported[-1][1] == 1
    with pytest.raises(FrameError, match="frame 1 of 1: found 512 x 768 px"):
        check_recording(gel_rig, [frames[0][:, :512]])


@pytest.mark.parametrize("dims", [2, 3])
def test_rigid_drift_finds_turn_shift_and_growth(gel_rig, dims):
    nominal = gel_rig.pattern.corners()
    turn = np.array([0.01, -0.02, 0.03]) if dims == 3 else np.array([0.0, 0.0, 0.03])
    shift = np.array([1e-4, -2e-4, 3e-4 if dims == 3 else 0.0])
    position = 1.004 * nominal @ Rotation.from_rotvec(turn).as_matrix().T + shift
    if dims == 2:
        position[..., 2] = np.nan
    position[2, 3] = np.nan
    drift = rigid_drift(position, nominal)
    assert drift is not None
    np.testing.assert_allclose(drift.turn, turn, atol=1e-12)
    np.testing.assert_allclose(drift.shift, shift, atol=1e-14)
    assert drift.growth == pytest.approx(0.004)
    assert drift.shape_peak < 1e-14
    assert rigid_drift(np.full_like(nominal, np.nan), nominal) is None
