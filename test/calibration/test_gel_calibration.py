"""Calibration by the gel's own pattern: displacement before and after, rigs of all kinds.

One test goes from images; the others from true corners with the noise that the tracker has then.
"""

from dataclasses import replace

import numpy as np
import pytest
from calibration_rigs import gel_frames, gel_grids, one_view_rig, two_view_rig

from cmp_tactile_bringup.calibration.practice import changed_rig
from cmp_tactile_processing.calibration.gel.calibrate import (
    GelCalibrationParameters,
    calibrate_gel,
    calibrate_gel_grids,
)
from cmp_tactile_processing.calibration.observation import track_frames
from cmp_tactile_processing.sensor.parts import RefractingLayer
from cmp_tactile_processing.stereo.rig import StereoRig
from hard_frames.deformation import deform, deformation_of

# Mean absolute error of a displacement, and share of the largest one, that are allowed.
MOST_ERROR_M, MOST_SHARE = 5e-6, 0.01
FRAMES = 10


def distorted_and_refracting(sensor):
    """A plate of 3 mm on the gel, and a lens with distortion: both held."""
    assert sensor.camera is not None
    camera = replace(sensor.camera, distortion=(-0.12, 0.03, 0.001, -0.0008, 0.0))
    layers = (RefractingLayer(-0.009, 1.49), RefractingLayer(-0.006, 1.41))
    return replace(sensor, camera=camera, optics=replace(sensor.optics, layers=layers))


def errors(sensor, grids, displacement, reference):
    """Error (rows, cols, 3) m of a displacement measured with that description."""
    wide = replace(sensor, triangulation=replace(sensor.triangulation, max_ray_gap=1e-2))
    rig = StereoRig(wide)
    markers = rig.triangulate(*(grids[name][0] if name in grids else None for name in SIDES))
    return np.asarray(markers.position - reference - displacement)


SIDES = ("left", "right")


def mean_errors(described, found, grids, zones):
    """Mean absolute error before and after, and the largest displacement, m."""
    nominal = described.pattern.corners()
    truth = deform(described, zones).corners() - nominal
    before, after = (
        float(np.abs(errors(sensor, grids, truth, nominal)).mean()) for sensor in (described, found)
    )
    return before, after, float(np.linalg.norm(truth, axis=-1).max())


def test_displacement_is_right_again(gel_rig):
    """Off by 1 degree, 0.5 mm and 1 %, images with noise: before, it is wrong by 100 um and more.

    The corners are numbered with the wrong description, two checkers away.
    """
    real = changed_rig(gel_rig, 0)
    outcome = calibrate_gel(gel_rig, gel_frames(real, FRAMES))
    assert outcome.accepted, outcome.findings
    assert outcome.sensor is not None
    zones = deformation_of("slide", gel_rig.pattern)
    grids = track_frames(gel_rig, gel_frames(real, 1, zones, seed=99))
    before, after, largest = mean_errors(gel_rig, outcome.sensor, grids, zones)
    assert before > 100e-6
    assert after < min(MOST_ERROR_M, MOST_SHARE * largest)


@pytest.mark.parametrize("seed", [1, 2])
def test_displacement_is_right_behind_a_plate(gel_rig, seed):
    """Distortion and layers are held; gel, mirrors and focal length are found through them."""
    described = distorted_and_refracting(gel_rig)
    real = changed_rig(described, seed)
    outcome = calibrate_gel_grids(described, gel_grids(real, FRAMES))
    assert outcome.accepted, outcome.findings
    assert outcome.sensor is not None
    zones = deformation_of("press", described.pattern, seed)
    grids = gel_grids(real, 1, zones, seed=99)
    before, after, largest = mean_errors(described, outcome.sensor, grids, zones)
    assert before > 100e-6
    assert after < min(MOST_ERROR_M, MOST_SHARE * largest)


@pytest.fixture(scope="module")
def outcome(gel_rig):
    """Of a mirror rig off by the usual amount."""
    return calibrate_gel_grids(gel_rig, gel_grids(changed_rig(gel_rig, 3)))


def test_mirrors_leave_one_joint_turn_open(outcome):
    """Two mirrored views do not see the camera: turning both mirrors and the gel shows nothing."""
    together = [item for item in outcome.estimates if item.name.startswith("together")]
    assert len(together) == 1
    assert not together[0].determined
    assert together[0].std == pytest.approx(1.0, abs=1e-3)
    assert together[0].after == pytest.approx(0.0, abs=1e-2)
    for part in ("gel: turn", "views.left.mirror: tilt", "views.right.mirror: tilt"):
        assert part in together[0].name
    focal = next(item for item in outcome.estimates if item.name == "camera.fx")
    assert focal.determined
    assert abs(focal.after / focal.before - 1) == pytest.approx(0.01, abs=2e-3)


def test_the_record_says_what_was_done(gel_rig, outcome):
    assert outcome.sensor is not None
    record = outcome.sensor.calibration
    assert record is not None
    assert (record.method, record.frames) == ("gel", 8)
    assert 0 < record.reprojection < 0.03
    assert 0 < record.ray_gap < 3e-6
    assert "camera.fx" in record.determined
    assert "camera.distortion[0]" in record.held
    assert not set(record.determined) & set(record.held)
    assert set(outcome.cameras) == {"left", "right"}
    assert outcome.verdict.startswith("Usable. The RMS error of the corners is 0.0")
    for item in outcome.residuals:
        assert item.residuals.shape == (gel_rig.pattern.rows * gel_rig.pattern.cols, 2)
        assert item.used.mean() > 0.95


def test_estimates_agree_with_their_deviations(gel_rig, outcome):
    """A focal length wrong by more than 5 of its own standard deviations is not one."""
    truth = changed_rig(gel_rig, 3).camera
    assert truth is not None
    for name in ("fx", "cx", "cy"):
        found = next(item for item in outcome.estimates if item.name == f"camera.{name}")
        assert abs(found.after - getattr(truth, name)) < 5 * found.std


def test_two_cameras_and_one_are_calibrated_too(gel_rig):
    for described in (two_view_rig(gel_rig), one_view_rig(gel_rig)):
        found = calibrate_gel_grids(described, gel_grids(changed_rig(described, 1)))
        assert found.accepted, found.findings
        assert found.sensor is not None
        assert found.sensor.calibration is not None
        assert found.sensor.calibration.reprojection < 0.03
        # Each camera sees the gel itself: nothing is left open.
        assert all(item.determined for item in found.estimates if item.std > 0)


def test_a_held_focal_length_stays(gel_rig):
    real = changed_rig(gel_rig, 3, focal=0.0)
    options = GelCalibrationParameters(focal=0.0, principal_point=0.0)
    found = calibrate_gel_grids(gel_rig, gel_grids(real), options)
    assert found.accepted, found.findings
    assert found.sensor is not None
    assert found.sensor.camera == gel_rig.camera


def test_the_result_states_what_stays_open(gel_rig, outcome):
    known = outcome.sensor.uncertainty
    names = list(known.std)
    assert not any("gel: " in name for name in names)
    # Images of another print are those of another distance: the fit follows the pitch.
    covariance = known.covariance(names, np.ones(len(names)))
    pitch, distance = names.index("pattern.pitch"), names.index("views.left.mirror.distance")
    by_pitch = covariance[distance, pitch] / covariance[pitch, pitch]
    assert abs(by_pitch) > 0.5 * abs(gel_rig.views["left"].mirror.distance)
    by_name = {item.name: item for item in outcome.estimates}
    for name in ("camera.fx", "views.left.mirror.distance"):
        scale = gel_rig.camera.fx if name == "camera.fx" else 1.0
        assert known.std[name] * scale >= by_name[name].std * (1 - 1e-6)
