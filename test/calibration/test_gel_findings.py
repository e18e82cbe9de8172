"""Frames from which no good calibration comes: reported, with what to do."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_rigs import gel_frames, gel_grids, two_view_rig

from cmp_tactile_bringup.calibration.practice import changed_rig
from cmp_tactile_processing.calibration.check import check_grids
from cmp_tactile_processing.calibration.gel.calibrate import calibrate_gel, calibrate_gel_grids
from cmp_tactile_processing.calibration.gel.fit import GelCalibrationParameters
from cmp_tactile_processing.errors import CalibrationError, FrameError, Severity
from cmp_tactile_processing.measured import Grid, GridFault, GridShape, Status
from cmp_tactile_processing.sensor.parts import PatternSurface
from hard_frames.deformation import Zone

TOUCH = (Zone(2e-3, 1e-3, 2e-3, depth=1e-4),)


@pytest.fixture(scope="module")
def real(gel_rig):
    """The rig as it was built."""
    return changed_rig(gel_rig, 1)


@pytest.fixture(scope="module")
def rest(real):
    """Eight frames of it at rest."""
    return gel_grids(real)


def only(outcome, severity):
    """The one finding, of that severity."""
    assert len(outcome.findings) == 1, outcome.findings
    assert outcome.findings[0].severity is severity
    assert outcome.accepted == (severity is Severity.WARNING)
    if not outcome.accepted:
        assert outcome.verdict.startswith(f"Not usable. {outcome.findings[0].text}")
    return outcome.findings[0]


def first(grids, count):
    return {name: view[:count] for name, view in grids.items()}


def test_grids_that_do_not_belong_together(gel_rig, rest):
    other = {name: [Grid.missing(GridShape(4, 4, 1), "")] for name in rest}
    uneven = {"left": rest["left"], "right": rest["right"][:5]}
    for grids, found in (
        ({}, "none"),
        ({"left": [], "right": []}, "0 of left, 0 of right"),
        ({"left": rest["left"]}, "8 of left"),
        (uneven, "8 of left, 5 of right"),
        (other, "GridShape"),
    ):
        for refuse in (calibrate_gel_grids, check_grids):
            with pytest.raises(CalibrationError, match=f"grids: found {found}"):
                refuse(gel_rig, grids)


def test_nothing_to_fit(gel_rig, rest):
    held = GelCalibrationParameters(turn=0.0, shift=0.0, focal=0.0, principal_point=0.0)
    with pytest.raises(CalibrationError, match="found standard deviations of 0"):
        calibrate_gel_grids(gel_rig, rest, held)


def test_too_few_frames(gel_rig, rest):
    two = only(calibrate_gel_grids(gel_rig, first(rest, 2)), Severity.ERROR)
    assert "Only 2 frames" in two.text
    assert "Record 8 frames or more" in two.advice
    four = only(calibrate_gel_grids(gel_rig, first(rest, 4)), Severity.WARNING)
    assert "Only 4 frames" in four.text
    with pytest.raises(CalibrationError, match="found no frames"):
        calibrate_gel(gel_rig, [])


def test_frames_taken_during_contact(gel_rig, real):
    """A dent of 0.1 mm: its place is reported and how deep."""
    touched = gel_grids(real, deformation=TOUCH)
    finding = only(calibrate_gel_grids(gel_rig, touched), Severity.ERROR)
    assert "the gel was touched" in finding.text
    assert "around x = 1.7 mm, y = 0.6 mm" in finding.text
    depth = float(finding.text.split(" mm along z")[0].rsplit(maxsplit=1)[1])
    assert -0.1 < depth < -0.05
    assert "nothing touches it" in finding.advice


def test_something_moves_during_the_recording(gel_rig, real, rest):
    touched = gel_grids(real, 2, TOUCH)
    dark = Grid.missing(gel_rig.pattern.shape, "too dark", fault=GridFault.DARK)
    frames = {name: [dark, *rest[name][:6], *touched[name]] for name in rest}
    outcome = calibrate_gel_grids(gel_rig, frames)
    texts = [item.text for item in outcome.findings if "moved during" in item.text]
    assert texts
    assert all("frames 8, 9 differ" in text for text in texts)
    assert not outcome.accepted


@pytest.mark.parametrize("changed", ["pitch", "surface"])
def test_a_wrong_pattern_shows_in_the_whole_field(gel_rig, rest, changed):
    wrong = {"pitch": 1.06 * gel_rig.pattern.pitch, "surface": PatternSurface("sphere_cap", 0.030)}
    pattern = replace(gel_rig.pattern, **{changed: wrong[changed]})
    finding = only(calibrate_gel_grids(replace(gel_rig, pattern=pattern), rest), Severity.ERROR)
    assert "The marker surface as a whole differs" in finding.text
    assert "measure pattern.pitch" in finding.advice
    assert "pattern.surface (sphere_cap of radius" in finding.advice


def test_a_wrong_pitch_of_a_plane_shows_in_the_distances(gel_rig):
    """A plane looks the same when everything grows: only the prior speaks against it."""
    flat = replace(gel_rig, pattern=replace(gel_rig.pattern, surface=PatternSurface()))
    frames = gel_grids(changed_rig(flat, 2))
    pattern = replace(flat.pattern, pitch=1.12 * flat.pattern.pitch)
    finding = only(calibrate_gel_grids(replace(flat, pattern=pattern), frames), Severity.WARNING)
    assert "All distances grew by" in finding.text
    assert "Measure pattern.pitch" in finding.advice


def test_another_kind_of_sensor(gel_rig, rest):
    """A focal length off by a fifth is ten standard deviations."""
    assert gel_rig.camera is not None
    camera = replace(gel_rig.camera, fx=gel_rig.camera.fx * 0.8, fy=gel_rig.camera.fy * 0.8)
    outcome = calibrate_gel_grids(replace(gel_rig, camera=camera), rest)
    assert not outcome.accepted
    texts = [item for item in outcome.findings if item.severity is Severity.ERROR]
    assert "camera.fx" in texts[0].text
    assert "more than 4 standard deviations" in texts[0].text
    assert texts[0].advice.startswith("Check that this is the description")


def test_exchanged_images(gel_rig, real):
    with pytest.raises(CalibrationError, match=r"left view's image in the right view's part"):
        calibrate_gel(gel_rig, [np.roll(*gel_frames(real, 1), gel_rig.image.width // 2, axis=1)])


def test_exchanged_grids_of_two_cameras(gel_rig):
    """Where the pattern is found all the same, the fit shows it."""
    described = two_view_rig(gel_rig)
    right_way = gel_grids(changed_rig(described, 1))
    swapped = {"left": right_way["right"], "right": right_way["left"]}
    finding = only(calibrate_gel_grids(described, swapped), Severity.ERROR)
    assert "The views are swapped" in finding.text
    assert finding.advice.startswith("Swap the cameras' cables")


def test_a_frame_of_another_size_is_named(gel_rig, real):
    frames = gel_frames(real, 2)
    match = "frame 2 of 2: found 1024 x 700 px, expected 1024 x 768 px"
    with pytest.raises(FrameError, match=match):
        calibrate_gel(gel_rig, [frames[0], frames[1][:700]])


def test_a_hidden_part_and_a_dark_frame(gel_rig, rest):
    """Fault and reason of the tracker are passed on; the rest is still calibrated with."""

    def without_columns(grid):
        corners, status = grid.corners.copy(), grid.corner_status.copy()
        corners[:, :4], status[:, :4] = np.nan, Status.MISSING
        return replace(
            grid,
            corners=corners,
            corner_status=status,
            fault=GridFault.PARTLY_HIDDEN,
            reason="48 corners not seen",
        )

    dark = Grid.missing(gel_rig.pattern.shape, "too dark", fault=GridFault.DARK)
    right = [*rest["right"], rest["right"][0]]
    left = [*(without_columns(grid) for grid in rest["left"]), dark]
    outcome = calibrate_gel_grids(gel_rig, {"left": left, "right": right})
    assert outcome.accepted
    texts = [item.text for item in outcome.findings]
    assert any("in frame 9: too dark." in text for text in texts)
    assert any("The left view shows 67% of the pattern: 48 corners not seen" in t for t in texts)
    assert outcome.sensor is not None
    assert outcome.sensor.calibration is not None
    assert outcome.sensor.calibration.frames == 8


def test_flaws_of_a_print_are_no_contact(gel_rig, real, rest):
    """Corners off by 8 um each, the same in all frames and in both views."""
    off = np.random.default_rng(5).normal(0.0, 8e-6, (12, 12, 2))
    worn = {}
    for name, view in rest.items():
        steps = np.stack([np.gradient(view[0].corners, axis=axis) for axis in (1, 0)], axis=-1)
        moved = np.einsum("ijkl,ijl->ijk", steps / real.pattern.pitch, off)
        worn[name] = [replace(grid, corners=grid.corners + moved) for grid in view]
    outcome = calibrate_gel_grids(gel_rig, worn)
    assert outcome.accepted
    assert outcome.findings == ()
