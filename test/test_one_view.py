"""Sensors with one view, and with two cameras, from frame to force, as a library and as a graph."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.sensor.description import load_sensor, write_sensor_description
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
# The first start of a version compiles the trackers.
START_TIMEOUT_S = 400.0
DATA = Path(__file__).parent.parent / "cmp_tactile_processing" / "test" / "data"


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


@dataclass(frozen=True)
class Played:
    """Messages of a replay that is repeated by topic, and how the container ended."""

    messages: dict[str, list[Any]]
    exit_code: int | None
    log: str


def _play(name, arguments, count, log):
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray

    from cmp_tactile_bringup.demo import RESULTS, Collector, ContainerProcess

    messages = {"surface_points": [], "markers": []}
    with (
        Collector(f"/{name}") as collector,
        ContainerProcess("replay", {**arguments, "loop": "true"}, log) as container,
    ):
        for topic, kind in (("surface_points", PointCloud2), ("markers", MarkerArray)):
            collector.node.create_subscription(kind, topic, messages[topic].append, 20)

        def all_came():
            topics = ("surface", "wrench", "force_field", "surface_points")
            for topic in RESULTS:
                messages[topic] = [item.message for item in collector.arrivals(topic)]
            stamps = [set(map(_stamp_of, messages[topic])) for topic in topics]
            drawn = {_stamp_of(item) for array in messages["markers"] for item in array.markers}
            return all(len(items) == count and items <= drawn for items in stamps)

        # What is sent before all have found one another is sent again.
        container.wait_for(all_came, START_TIMEOUT_S, "the results")
    return Played(messages, container.exit_code, log.read_text())


def _stamp_of(message):
    return message.header.stamp.sec, message.header.stamp.nanosec


@pytest.mark.ros
def test_a_sensor_with_one_view_runs_as_a_graph(tmp_path):
    """The sample rig's left mirror alone."""
    pytest.importorskip("rclpy", reason="ROS 2 is not there")
    from cmp_tactile_processing.ros.messages.reading import force_field_from_msg, surface_from_msg

    sample, description = load_sensor("sample_rig"), tmp_path / "one_eyed.yaml"
    optics, views = replace(sample.optics, type="monocular"), {"left": sample.views["left"]}
    sensor = replace(sample, name="one_eyed", optics=optics, views=views)
    write_sensor_description(description, sensor)
    frames = tmp_path / "frames"
    frames.mkdir()
    names = ("rest", "rest", "slide")
    for number, name in enumerate(names):
        cv2.imwrite(str(frames / f"{number}.png"), cv2.imread(str(DATA / f"{name}.png"), 0))
    arguments = {"input": str(frames), "sensor": str(description), "frame_rate": "5.0"}
    played = _play("one_eyed", arguments, len(names), tmp_path / "container.log")
    assert played.exit_code == 0, played.log
    assert not played.messages["right/grid"]
    rest, slide = (
        surface_from_msg(choose(played.messages["surface"], key=_stamp_of), sensor.pattern.shape)
        for choose in (min, max)
    )
    with np.load(DATA / "slide.npz", allow_pickle=False) as stored:
        truth = stored["corners_m"] - sensor.pattern.corners()
    assert (slide.status == Status.MEASURED).all()
    assert np.isnan(slide.displacement[..., 2]).all()
    assert np.abs(rest.displacement[..., :2]).mean() < IN_PLANE_M
    # The slide sinks by up to 1 mm, and the left mirror looks at a slant.
    along = np.sum(slide.displacement[..., :2] * truth[..., :2]) / np.sum(truth[..., :2] ** 2)
    assert 0.5 < along < 1.5
    cloud = max(played.messages["surface_points"], key=_stamp_of)
    values = np.frombuffer(cloud.data, np.float32).reshape(20, 20, 6)
    assert not cloud.is_dense
    assert np.isnan(values[..., [2, 5]]).all()
    assert np.isfinite(values[..., [0, 1, 3, 4]]).all()
    field = force_field_from_msg(max(played.messages["force_field"], key=_stamp_of))
    assert np.isfinite(field.wrench).all()
    drawn = [marker for array in played.messages["markers"] for marker in array.markers]
    points = {marker.ns: len(marker.points) for marker in sorted(drawn, key=_stamp_of)}
    # Two triangles a cell; the ends of a shaft and two barbs an arrow.
    assert points["surface"] == 6 * 19 * 19
    assert points["displacement"] > 6 * 300
