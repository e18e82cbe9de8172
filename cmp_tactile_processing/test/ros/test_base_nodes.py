"""Nodes publish results first, and refuse what is of another sensor."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from cmp_tactile_msgs.msg import ForceField as ForceFieldMsg
from cmp_tactile_msgs.msg import Surface as SurfaceMsg
from cmp_tactile_processing.nodes.force_reconstructor import ForceReconstructor
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.ros.messages.conversions import surface_to_msg
from cmp_tactile_processing.ros.wiring import Wiring, joining
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

pytestmark = pytest.mark.ros

SENSOR = load_sensor("sample_rig")
HEADER = Header(stamp=Time(sec=5))


@pytest.fixture
def published(monkeypatch):
    """Topics of a node in the order in which it publishes, below its namespace."""

    def watch(node):
        order = []
        for publisher in node.publishers:

            def publish(message, *, at=publisher, send=publisher.publish):
                order.append(at.topic_name.removeprefix(f"{node.get_namespace()}/"))
                send(message)

            monkeypatch.setattr(publisher, "publish", publish)
        return order

    return watch


def _until(ros, order, count):
    ros.wait(lambda: len(_results(order)) >= count, f"{count} messages; published: {order}")
    return _results(order)[:count]


def _results(order):
    return [topic for topic in order if topic != "/diagnostics"]


def test_the_wrench_is_published_first(ros, published):
    """A controller waits for it."""
    node = ros.start(ForceReconstructor, wait_for_model=True)
    ros.listen(WrenchStamped, "wrench")
    ros.listen(ForceFieldMsg, "force_field")
    ros.listen(PointCloud2, "force_points")
    ros.wait_subscribed(node, "wrench", "force_field", "force_points")
    order = published(node)
    surface = surface_to_msg(
        surface_at_rest(Reference.nominal(SENSOR), SENSOR.pattern.shape), HEADER
    )
    ros.publisher(SurfaceMsg, "surface").publish(surface)
    assert _until(ros, order, 3) == ["wrench", "force_field", "force_points"]


def test_the_surface_of_another_pattern_is_refused(ros):
    """Two sensors of one container may be remapped onto each other."""
    other = replace(SENSOR.pattern, rows=SENSOR.pattern.rows - 1)
    sensor = replace(SENSOR, pattern=other)
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    with joining(Wiring()):
        node, source = ros.start(ForceReconstructor, wait_for_model=True), ros.start(ViewSplitter)
        output = source.add_result(SurfaceMsg, "surface", surface_to_msg)
    node.attach()
    output.publish(surface, HEADER)
    assert node.diagnostics.bad_frames == 1
    assert "found 19, 20, 6, expected 20, 20, 6" in node.diagnostics.last_error
