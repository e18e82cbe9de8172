"""The force node publishes what the force model gives, and nothing waits while that is built.

That the forces are those of the pipeline: test_chain.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.measured import Status, Surface
from cmp_tactile_processing.nodes.force_reconstructor import ForceReconstructor
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages import conversions
from cmp_tactile_processing.ros.messages.conversions import surface_to_msg
from cmp_tactile_processing.ros.wiring import Wiring, joining
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

pytestmark = pytest.mark.ros

SENSOR = load_sensor("sample_rig")
SHAPE = SENSOR.pattern.shape
# The first build on a machine solves the finite-element model; later ones read the cache.
BUILD_TIMEOUT_S = 400.0


def _press(depth_m: float = 3e-4) -> Surface:
    """A smooth dent in the middle, with one marker missing."""
    reference = SENSOR.pattern.corners()
    displacement = np.zeros_like(reference)
    distance2 = (reference[..., :2] ** 2).sum(axis=-1)
    displacement[..., 2] = -depth_m * np.exp(-distance2 / (2 * 0.002**2))
    status = np.ones(SHAPE.corners, np.uint8)
    status[4, 5] = Status.MISSING
    displacement[4, 5] = np.nan
    return replace(
        surface_at_rest(Reference.nominal(SENSOR), SHAPE),
        position=reference + displacement,
        displacement=displacement,
        status=status,
    )


def _surface_msg(number: int, surface: Surface | None = None) -> SurfaceMsg:
    header = Header(stamp=Time(sec=number), frame_id="sample_rig_gel_frame")
    return surface_to_msg(surface or _press(), header)


def test_wrench_field_and_points_are_of_one_frame_and_a_bad_one_is_named(ros, count_calls):
    clouds_made = count_calls(conversions, "organised_cloud")
    node = ros.start(ForceReconstructor, wait_for_model=True)
    fields, wrenches = ros.listen(ForceFieldMsg, "force_field"), ros.listen(WrenchStamped, "wrench")
    ros.wait_subscribed(node, "force_field", "wrench")
    publisher = ros.publisher(SurfaceMsg, "surface")
    bad = _surface_msg(1)
    bad.displacement = bad.displacement[:-3]
    publisher.publish(bad)
    publisher.publish(_surface_msg(2))
    ros.wait(lambda: fields and wrenches, "the force", BUILD_TIMEOUT_S)
    assert not clouds_made
    clouds = ros.listen(PointCloud2, "force_points")
    ros.wait_subscribed(node, "force_points")
    publisher.publish(_surface_msg(3))
    ros.wait(lambda: clouds and len(fields) > 1, "the points")
    assert node.diagnostics.bad_frames == 1
    assert "displacement: found 1197 values, expected 1200" in node.diagnostics.last_error
    wrench = wrenches[0]
    assert wrench.wrench.force.z < -0.05, "a press pushes the gel towards -z"
    header = Header(stamp=Time(sec=2), frame_id="sample_rig_gel_frame")
    assert (fields[0].header, wrench.header) == (header, header)
    assert clouds[0].header == Header(stamp=Time(sec=3), frame_id="sample_rig_gel_frame")
    assert wrench.wrench == fields[0].wrench
    values = np.frombuffer(clouds[0].data, np.float32).reshape(-1, 6)
    assert (clouds[0].height, clouds[0].width) == (fields[1].rows, fields[1].cols)
    np.testing.assert_array_equal(values[:, 3:].ravel(), fields[1].force)


def test_building_the_model_blocks_nothing_and_is_reported(ros):
    node = ros.start(ForceReconstructor)
    fields = ros.listen(ForceFieldMsg, "force_field")
    publisher = ros.publisher(SurfaceMsg, "surface")
    publisher.publish(_surface_msg(0))
    ros.wait(lambda: node.diagnostics.frames_in == 1, "the first surface")
    node._update_diagnostics()
    assert node.diagnostics.extra["model"] == "building"
    assert node.diagnostics.passed_over == 1
    names = GetParameters.Request(names=["regularization"])
    service = f"{ros.namespace}/force_reconstructor/get_parameters"
    (value,) = ros.call(GetParameters, service, names).values
    assert value.double_value == SENSOR.force.regularization
    assert not fields

    sent = 1
    while not fields:
        publisher.publish(_surface_msg(sent))
        sent += 1
        ros.wait(lambda s=sent: node.diagnostics.frames_in == s, "the surface to be taken")
        ros.run(0.05)
        assert sent < BUILD_TIMEOUT_S / 0.05
    node._update_diagnostics()
    extra = node.diagnostics.extra
    assert extra["model"] == "ready"
    assert node.diagnostics.passed_over + node.diagnostics.sent.frames == sent


def test_parameters_of_force_and_slip_may_be_changed(ros):
    node = ros.start(ForceReconstructor, wait_for_model=True)
    fields = ros.listen(ForceFieldMsg, "force_field")
    publisher = ros.publisher(SurfaceMsg, "surface")
    # Frames of half the noise that the new parameters speak of.
    good = {
        "noise_depth": 2 * SENSOR.force.noise_depth,
        "noise_in_plane": 2 * SENSOR.force.noise_in_plane,
        "slip.min_normal_force": 1000.0,
    }
    assert all(answer.successful for answer in ros.set_parameters("force_reconstructor", good))

    def renewed() -> bool:
        publisher.publish(_surface_msg(1))
        ros.run(0.05)
        return bool(fields) and fields[-1].noise_scale < 0.75 * fields[0].noise_scale

    ros.wait(renewed, "a force field of the new model", BUILD_TIMEOUT_S)
    assert node._slip.value.min_normal_force == 1000.0
    assert node.diagnostics.failure == ""


def _report(node) -> tuple[bytes, str, dict[str, str]]:
    status = node._status()
    return status.level, status.message, {pair.key: pair.value for pair in status.values}


def test_lost_frames_and_nan_are_reported_and_end_nothing(ros):
    """Frames without a marker, with NaN where a marker is measured, and good ones again."""
    node = ros.start(ForceReconstructor, wait_for_model=True)
    fields = ros.listen(ForceFieldMsg, "force_field")
    ros.wait_subscribed(node, "force_field")
    publisher = ros.publisher(SurfaceMsg, "surface")
    press = _press()
    lost = replace(
        press,
        position=np.full_like(press.position, np.nan),
        displacement=np.full_like(press.displacement, np.nan),
        status=np.zeros_like(press.status),
    )
    covariance = np.full_like(press.covariance, np.nan)
    impossible = _surface_msg(3)
    impossible.displacement[30] = float("nan")
    sent = [_surface_msg(1, lost), _surface_msg(2, lost), impossible]
    sent += [_surface_msg(k, replace(press, covariance=covariance)) for k in (4, 5)]
    for msg in sent[:3]:
        publisher.publish(msg)
    ros.wait(lambda: node.diagnostics.frames_in == 3, "the lost frames")
    level, text, values = _report(node)
    assert level == DiagnosticStatus.WARN
    assert "bad frames, last:" in text
    assert values["flags"] == "few_markers"
    for msg in sent[3:]:
        publisher.publish(msg)
    ros.wait(lambda: len(fields) == 4, "the good frames")
    assert [bool(np.isnan(field.wrench.force.z)) for field in fields] == [True, True, False, False]
    level, text, values = _report(node)
    assert level == DiagnosticStatus.OK
    # Nothing that is warned of; the model alone raises no flag for this dent, the node may.
    assert values["flags"] in {"", "beyond_markers"}
    assert int(values["contacts"]) == len(fields[-1].contacts) > 0


def test_the_wrench_is_published_first(ros, monkeypatch):
    """A controller waits for it."""
    node = ros.start(ForceReconstructor, wait_for_model=True)
    topics = {"wrench": WrenchStamped, "force_field": ForceFieldMsg, "force_points": PointCloud2}
    for topic, kind in topics.items():
        ros.listen(kind, topic)
    ros.wait_subscribed(node, *topics)
    order = []
    for publisher in node.publishers:

        def publish(message, *, at=publisher.topic_name, send=publisher.publish):
            order.append(at.rpartition("/")[2])
            send(message)

        monkeypatch.setattr(publisher, "publish", publish)
    ros.publisher(SurfaceMsg, "surface").publish(_surface_msg(1))
    ros.wait(lambda: "force_points" in order, "the points")
    assert [topic for topic in order if topic in topics] == list(topics)


def test_the_surface_of_another_pattern_is_refused(ros):
    """Two sensors of one container may be remapped onto each other."""
    other = replace(SENSOR.pattern, rows=SENSOR.pattern.rows - 1)
    sensor = replace(SENSOR, pattern=other)
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    with joining(Wiring()):
        node, source = ros.start(ForceReconstructor, wait_for_model=True), ros.start(ViewSplitter)
        output = source.add_result(SurfaceMsg, "surface", surface_to_msg)
    node.attach()
    output.publish(surface, Header(stamp=Time(sec=5)))
    assert node.diagnostics.bad_frames == 1
    assert "found 19, 20, 6, expected 20, 20, 6" in node.diagnostics.last_error
