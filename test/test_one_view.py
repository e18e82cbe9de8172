"""Sensors with one view, and with two cameras, from frame to surface.

Nodes of one view: cmp_tactile_processing/test/nodes/test_chain.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.sensor.parts import (
    Camera,
    ImageSize,
    Optics,
    PatternSurface,
    RefractingLayer,
    Roi,
    ViewDescription,
)
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import OpticalTruth
from hard_frames.deformation import Zone, deform
from hard_frames.studio import PatternCase, PatternStudio, pattern_rig

CAP = PatternSurface("sphere_cap", 0.027)
DISTORTION = (-0.1, 0.02, 0.0, 0.0, 0.0)
LAYERS = (RefractingLayer(-0.009, 1.49), RefractingLayer(-0.006, 1.41))
SLIDE = (Zone(0.0, 0.0, 9e-3, shift=(6e-4, -3e-4)),)
PRESS = (Zone(5e-4, 0.0, 3.6e-3, depth=6e-4, spread=0.09),)
# A twentieth of a pixel of 35 um: what the tracker is allowed on such frames.
IN_PLANE_M = 2e-6


def _looking_from(*centre):
    """T (4, 4): a camera there that looks at the apex, its x axis in the gel's xz plane."""
    z = -np.array(centre) / np.linalg.norm(centre)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = [np.cross(y, z), y, z]
    T[:3, 3] = -T[:3, :3] @ centre
    return T


def one_view_rig(surface):
    """A camera below the gel, a little aside, behind a plate."""
    return replace(
        pattern_rig(surface=surface),
        name="one_view",
        image=ImageSize(640, 480),
        camera=Camera("pinhole", 800.0, 800.0, 319.5, 239.5, DISTORTION),
        optics=Optics("monocular", _looking_from(0.0, 0.002, -0.031), LAYERS),
        views={"left": ViewDescription(Roi(0, 0, 640, 480))},
    )


def two_camera_rig():
    """Two cameras side by side, their pictures beside each other in one frame."""
    views = {}
    for name, corner, x in (("left", 0, -0.012), ("right", 640, 0.012)):
        camera = Camera("pinhole", 800.0, 800.0, corner + 319.5, 239.5, DISTORTION)
        pose = _looking_from(x, 0.0, -0.028)
        views[name] = ViewDescription(Roi(corner, 0, 640, 480), None, camera, pose)
    return replace(
        pattern_rig(surface=CAP),
        name="two_cameras",
        image=ImageSize(1280, 480),
        camera=None,
        optics=Optics("two_view", None, LAYERS),
        views=views,
    )


@pytest.fixture(scope="module")
def measured():
    """The surface that a sensor measures of a deformation at noise 4, and the true one."""
    studio = PatternStudio()

    def measure(sensor, zones):
        case = PatternCase(sensor.name, sensor, zones, CameraSettings(read_noise=4.0))
        image, rig = studio.photograph(case).image, StereoRig(sensor)
        grids = {
            name: GridTracker(sensor, name).track(split_frame(image, view.placement))
            for name, view in rig.views.items()
        }
        markers = rig.triangulate(grids.get("left"), grids.get("right"))
        truth = OpticalTruth(sensor).surface(deform(sensor, zones))
        return Reference.nominal(sensor).surface(markers), truth

    return measure


def _errors(found, truth):
    assert (found.status == Status.MEASURED).all()
    return np.asarray(np.abs(found.displacement - truth.displacement))


@pytest.mark.parametrize("zones", [(), SLIDE], ids=["rest", "slide"])
def test_one_view_measures_slides_at_constant_height(measured, zones):
    """On a plane, where what slides stays on the known surface."""
    found, truth = measured(one_view_rig(PatternSurface()), zones)
    assert _errors(found, truth)[..., :2].mean() < IN_PLANE_M
    assert np.isnan(found.displacement[..., 2]).all()
    assert np.isnan(found.position[..., 2]).all()
    assert np.isnan(found.ray_gap).all()
    assert np.isnan(found.covariance[..., 2, :]).all()
    deviation = np.sqrt(np.diagonal(found.covariance, 0, -2, -1))[..., :2]
    ratio = np.std((found.displacement - truth.displacement)[..., :2] / deviation)
    # Claimed and true errors agree within a factor of two.
    assert 0.5 < ratio < 2


def test_one_view_takes_depth_for_displacement_in_proportion_to_its_slant(measured):
    """What one view gets wrong, and by how much: dz times the slope of the ray."""
    sensor = one_view_rig(PatternSurface())
    found, truth = measured(sensor, PRESS)
    (view,) = StereoRig(sensor).views.values()
    _, v = view.rays(view.project(truth.position))
    slant = -truth.displacement[..., 2:] * v[..., :2] / v[..., 2:]
    wrong = (found.displacement - truth.displacement)[..., :2]
    assert np.abs(wrong).max() > 20e-6
    np.testing.assert_allclose(wrong, slant, atol=6 * IN_PLANE_M)


@pytest.mark.parametrize("zones", [(), PRESS], ids=["rest", "press"])
def test_two_cameras_measure_all_three(measured, zones):
    errors = _errors(*measured(two_camera_rig(), zones))
    assert errors[..., :2].mean() < IN_PLANE_M
    # The limit for clean frames of the mirror rig; this one sees the gel from further apart.
    assert errors[..., 2].mean() < 3e-6


def _sheet(rig):
    """The rig with a coded print on its whole skin, of which the middle is numbered."""
    part = replace(rig.pattern, rows=14, cols=13, code="dots", border="beyond_view")
    return replace(rig, pattern=part)


@pytest.mark.parametrize(
    "rig", [one_view_rig(PatternSurface()), two_camera_rig()], ids=["one view", "two cameras"]
)
def test_a_coded_sheet_beyond_the_view_is_measured_after_a_slide_by_checkers(rig, measured):
    """In a first frame: nothing but the dots shows that the gel has moved."""
    sensor = _sheet(rig)
    shift = 2 * sensor.pattern.pitch, -sensor.pattern.pitch
    found, truth = measured(sensor, (Zone(radius=1.0, shift=shift),))
    assert _errors(found, truth)[..., :2].mean() < 2 * IN_PLANE_M
