"""Parameters of whole nodes: a dump loads again, refusals say why, changes lose no frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from sensor_msgs.msg import Image

from cmp_tactile_msgs.msg import Grid
from cmp_tactile_processing.nodes.force_reconstructor import ForceReconstructor
from cmp_tactile_processing.nodes.gridline_tracker import GridlineTracker
from cmp_tactile_processing.nodes.stereo_triangulator import StereoTriangulator
from cmp_tactile_processing.nodes.surface_visualizer import SurfaceVisualizer
from cmp_tactile_processing.nodes.view_splitter import ViewSplitter
from cmp_tactile_processing.sensor.description import load_sensor

pytestmark = pytest.mark.ros

SENSOR = load_sensor("sample_rig")
# Of each node some values that are not the defaults, one of every kind that it has.
NODES: list[tuple[Any, dict[str, Any]]] = [
    (ViewSplitter, {"parent_frame": "finger", "mount_position": [0.0, 1e-9, 2.5]}),
    (GridlineTracker, {"view": "right", "follow": False, "red": 1e-05, "print_frames": 3}),
    (StereoTriangulator, {"auto_reference": "never", "max_ray_gap": 2e-07}),
    (ForceReconstructor, {"large_press": "on", "slip.full_ratio": 1.0, "noise_depth": 1e-09}),
    (SurfaceVisualizer, {"up": [0.0, -1.0, 0.5], "force_gain": 0.0}),
]


def _values(ros, name: str) -> dict[str, Any]:
    """Parameters of a node as `ros2 param dump` asks for them."""
    service = f"{ros.namespace}/{name}"
    listed = ros.call(ListParameters, f"{service}/list_parameters", ListParameters.Request())
    names = sorted(listed.result.names)
    request = GetParameters.Request(names=names)
    values = ros.call(GetParameters, f"{service}/get_parameters", request).values
    found = [parameter_value_to_python(value) for value in values]
    return dict(zip(names, (v if _is_plain(v) else list(v) for v in found), strict=True))


def _is_plain(value: Any) -> bool:
    return isinstance(value, (bool, int, float, str))


def _dump(ros, name: str, path: Path) -> dict[str, Any]:
    """Write the file that `ros2 param dump` prints: sections nested by the dots of the names."""
    values = _values(ros, name)
    nested: dict[str, Any] = {}
    for key, value in values.items():
        section = nested
        *outer, last = key.split(".")
        for part in outer:
            section = section.setdefault(part, {})
        section[last] = value
    content = {f"{ros.namespace}/{name}": {"ros__parameters": nested}}
    path.write_text(yaml.dump(content, default_flow_style=False), encoding="utf-8")
    return values


@pytest.mark.parametrize(("node_class", "overrides"), NODES, ids=lambda item: str(item)[:12])
def test_a_dump_loads_again_unchanged(ros, tmp_path, node_class, overrides):
    node = ros.start(node_class, sensor_name="thumb", **overrides)
    name, path = node.get_name(), tmp_path / "dump.yaml"
    before = _dump(ros, name, path)
    assert {key: before[key] for key in overrides} == overrides
    ros.executor.remove_node(node)
    node.destroy_node()
    ros._nodes.remove(node)
    again = ros._add(
        node_class(
            context=ros.context,
            namespace=ros.namespace,
            cli_args=["--ros-args", "--params-file", str(path)],
            use_global_arguments=False,
        )
    )
    assert again.get_name() == name
    assert _values(ros, name) == before


REFUSED: list[tuple[str, Any, str]] = [
    ("slip.incipient_ratio", 0.9, "found 0.9, expected at most slip.full_ratio, 0.75"),
    ("slip.min_normal_force", math.nan, "found nan, expected a finite number"),
    ("contact_pressure_floor", -1.0, "found -1.0, expected at least 0.0 Pa"),
    ("noise_depth", 1.0, "Parameter noise_depth out of range"),
    ("two_pass", "no", "two_pass: found 'no', expected true or false"),
    ("large_press", "sometimes", "found 'sometimes', expected one of auto, on, off"),
    ("wait_for_model", True, "read-only parameter: wait_for_model"),
    ("noise_deph", 1e-6, "no such parameter; did you mean 'noise_depth'?"),
]


def test_what_cannot_be_is_refused_with_the_reason_and_changes_nothing(ros):
    node = ros.start(ForceReconstructor)
    before = _values(ros, node.get_name())
    for name, value, reason in REFUSED:
        (alone,) = ros.set_parameters(node.get_name(), {name: value})
        # One bad value refuses all that are set together with it.
        both = {"smoothing_length": 2e-3, name: value}
        for answer in (alone, ros.set_parameters(node.get_name(), both, together=True)):
            assert not answer.successful, name
            assert reason in answer.reason
    assert _values(ros, node.get_name()) == before


def test_a_name_that_is_spelled_wrongly_is_reported_at_the_start(ros, capfd):
    """In a file, ROS takes it without a word."""
    qos = f"qos_overrides.{ros.namespace}/surfaces.subscription.depth"
    ros.start(ForceReconstructor, noise_deph=1e-6, noise_depth=1e-5, **{qos: 5})
    log = capfd.readouterr().err
    reported = [line for line in log.splitlines() if "WARN" in line]
    assert len(reported) == 2, log
    assert "noise_deph: no such parameter; did you mean 'noise_depth'? (given" in reported[0]
    meant = qos.replace("surfaces", "surface")
    assert f"{qos}: no such parameter; did you mean '{meant}'?" in reported[1]


def test_parameters_change_between_frames_and_lose_none(ros):
    """The tracker is built again by each change, while frames come in."""
    node = ros.start(GridlineTracker)
    grids = ros.listen(Grid, "left/grid")
    ros.wait_subscribed(node, "left/grid")
    publisher = ros.publisher(Image, "left/image_raw")
    roi = SENSOR.views["left"].roi
    image = np.full((roi.height, roi.width), 128, np.uint8)
    message = Image(height=roi.height, width=roi.width, step=roi.width, encoding="mono8")
    message.data.frombytes(image.tobytes())
    trackers = set()
    for k in range(6):
        message.header.stamp = Time(sec=1 + k)
        publisher.publish(message)
        (answer,) = ros.set_parameters(node.get_name(), {"follow": bool(k % 2)})
        assert answer.successful
        trackers.add(id(node._tracker))
    ros.wait(lambda: len(grids) == 6, "a grid of every image")
    assert [grid.header.stamp.sec for grid in grids] == [1, 2, 3, 4, 5, 6]
    assert len(trackers) > 1
    assert node.diagnostics.bad_frames == 0
    assert [item.lost for item in node.diagnostics.inputs] == [0] * len(node.diagnostics.inputs)
