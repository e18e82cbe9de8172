"""Tables of topics, services and parameters of all components and of their container.

They are read from running nodes.

`setup/run python3 docs/interface_tables.py docs/nodes.md` renews what follows the marker line of
that file.
"""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.services import ContainerServices
from cmp_tactile_processing.ros.parameters import allowed
from cmp_tactile_processing.sensor.description import DEFAULT_SENSOR
from cmp_tactile_processing.sensor.parameter_table import renew_file, with_generated_section

MARKER = "<!-- made by docs/interface_tables.py from here on -->"
ENTRY_POINT_GROUP = "cmp_tactile_components"
NAMESPACE = "/sensor"
CHAIN = (
    "CameraDriver",
    "Replay",
    "Recorder",
    "ViewSplitter",
    "GridlineTracker",
    "StereoTriangulator",
    "ForceReconstructor",
    "SurfaceVisualizer",
    "GraspStateEstimator",
    "WrenchBroadcaster",
)
# What every node of ROS 2 has, or every lifecycle node.
COMMON_TOPICS = ("/rosout", "/parameter_events", "transition_event")
COMMON_SERVICES = (
    "parameters",
    "parameter_types",
    "parameters_atomically",
    "type_description",
    "state",
    "available_states",
    "available_transitions",
    "transition_graph",
)
# Of parameters that are given another value here.
KNOWN_DEFAULTS = {"sensor_description": DEFAULT_SENSOR, "source": "images", "autostart": True}
COMMON_PARAMETERS = (
    "use_sim_time",
    "start_type_description_service",
    "qos_overrides.",
)
CONTAINER = """Loads, unloads and lists components, as ComposableNodeContainer of launch_ros and
`ros2 component` ask for it."""


@dataclass(frozen=True)
class Topic:
    """One end of a topic.  name: relative to the namespace of the sensor unless it is global."""

    direction: str
    name: str
    type: str
    qos: str


@dataclass(frozen=True)
class NodeInterface:
    """What a user sees of a node; descriptors and values of its parameters by name.

    plugin: of a component, as `ros2 component load` takes it; else empty.  package: which has the
    executable of the node's name.
    """

    plugin: str
    package: str
    name: str
    description: str
    topics: tuple[Topic, ...]
    services: tuple[tuple[str, str], ...]
    parameters: tuple[tuple[Any, Any], ...]


def read_interfaces() -> list[NodeInterface]:
    """The interfaces of all installed components, in the order of the chain.

    Starts each of them for a moment, with default parameters where it can do with them.
    """
    context = rclpy.Context()
    context.init()
    try:
        with tempfile.TemporaryDirectory() as folder:
            cv2.imwrite(str(Path(folder) / "0.png"), np.zeros((768, 1024), np.uint8))
            needed = {
                # The source with topics of its own.  It is opened, and gives no frame.
                "CameraDriver": [
                    Parameter("source", value="simulated"),
                    Parameter("input", value="grasp"),
                    Parameter("autostart", value=False),
                ],
                "Replay": [Parameter("input", value=folder)],
                "Recorder": [Parameter("autostart", value=False)],
                # Its default would have a second force model built.
                "ForceReconstructor": [Parameter("sensor_description", value="sample_rig")],
            }
            points = {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}
            interfaces = [
                _read_component(
                    plugin,
                    points[plugin].load(),
                    context=context,
                    parameter_overrides=needed.get(plugin.rpartition("::")[2], []),
                )
                for plugin in sorted(points, key=_place)
            ]
            return [
                *(_with_camera(item, points[item.plugin].load(), context) for item in interfaces),
                _read_container(context),
            ]
    finally:
        context.try_shutdown()


def _place(plugin: str) -> tuple[int, str]:
    """Where it stands in the chain; what is unknown, after it."""
    name = plugin.rpartition("::")[2]
    return CHAIN.index(name) if name in CHAIN else len(CHAIN), name


def _read_component(plugin: str, node_class: Any, **node_kwargs: Any) -> NodeInterface:
    node = node_class(namespace=NAMESPACE, use_global_arguments=False, **node_kwargs)
    try:
        description = inspect.getdoc(node_class) or ""
        if isinstance(node, LifecycleNode):
            description += "  It is a lifecycle node."
            node.trigger_configure()
        given = {item.name for item in node_kwargs["parameter_overrides"]}
        defaults = dict.fromkeys(given) | KNOWN_DEFAULTS
        return _read(node, plugin, plugin.partition("::")[0], description, defaults)
    finally:
        node.destroy_node()


def _with_camera(interface: NodeInterface, node_class: Any, context: Any) -> NodeInterface:
    """Of the camera driver, the parameters of its source v4l2 too; no camera is needed."""
    if not interface.plugin.endswith("::CameraDriver"):
        return interface
    camera = [Parameter("source", value="v4l2"), Parameter("autostart", value=False)]
    node = node_class(context=context, use_global_arguments=False, parameter_overrides=camera)
    try:
        names = {descriptor.name for descriptor, _ in interface.parameters}
        more = (
            item for item in _read(node, "", "", "", {}).parameters if item[0].name not in names
        )
        return replace(interface, parameters=(*interface.parameters, *more))
    finally:
        node.destroy_node()


def _read_container(context: Any) -> NodeInterface:
    container = ComponentContainer(context)
    services = ContainerServices(container, "component_container", NAMESPACE)
    try:
        return _read(services.node, "", "cmp_tactile_bringup", CONTAINER, {})
    finally:
        container.shutdown()
        services.close()


def _read(
    node: Any, plugin: str, package: str, description: str, defaults: dict[str, Any]
) -> NodeInterface:
    return NodeInterface(
        plugin=plugin,
        package=package,
        name=node.get_name(),
        description=description,
        topics=tuple(_topics(node)),
        services=tuple(_services(node)),
        parameters=tuple(
            (node.describe_parameter(name), defaults.get(name, value.value))
            for name, value in node.get_parameters_by_prefix("").items()
            if not name.startswith(COMMON_PARAMETERS)
        ),
    )


def _topics(node: Any) -> Iterator[Topic]:
    for direction, ends in (("in", node.subscriptions), ("out", node.publishers)):
        for end in ends:
            name = _relative(node, end.topic_name)
            if not name.endswith(COMMON_TOPICS):
                yield Topic(direction, name, _type_name(end.msg_type), _qos(end.qos_profile))


def _services(node: Any) -> Iterator[tuple[str, str]]:
    for service in node.services:
        name = _relative(node, service.service_name)
        if name.rpartition("/")[2].partition("_")[2] not in COMMON_SERVICES:
            yield name, _type_name(service.srv_type)


def _relative(node: Any, name: str) -> str:
    own = f"{node.get_fully_qualified_name()}/"
    if name.startswith(own):
        return "~/" + name.removeprefix(own)
    return name.removeprefix(f"{NAMESPACE}/")


def _type_name(interface: type) -> str:
    package, _, _ = interface.__module__.partition(".")
    return f"{package}/{interface.__name__}"


def _qos(profile: Any) -> str:
    words = "reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"
    if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        words += ", latched"
    return f"{words}, {profile.depth}"


def as_markdown(interfaces: list[NodeInterface]) -> str:
    """The tables, one section a node."""
    sections = [line for interface in interfaces for line in _section(interface)]
    return "\n".join(sections)


def _section(node: NodeInterface) -> Iterator[str]:
    yield f"## {node.name}\n"
    component = f"Component `{node.plugin}`, executable" if node.plugin else "Executable"
    yield f"{component} `ros2 run {node.package} {node.name}`.\n"
    yield f"{node.description}\n"
    yield "| | topic | type | QoS |\n|---|---|---|---|"
    for topic in node.topics:
        yield f"| {topic.direction} | `{topic.name}` | {topic.type} | {topic.qos} |"
    for name, type_name in node.services:
        yield f"| service | `{name}` | {type_name} | |"
    yield ""
    if node.parameters:
        yield from _parameter_rows(node.parameters)
        yield ""


def _parameter_rows(parameters: Iterable[tuple[Any, Any]]) -> Iterator[str]:
    yield "| parameter | default | allowed | while running | meaning |\n|---|---|---|---|---|"
    for descriptor, value in parameters:
        change = "fixed" if descriptor.read_only else "may change"
        yield (
            f"| `{descriptor.name}` | {_default(value)} | {allowed(descriptor)} | {change} "
            f"| {descriptor.description} |"
        )


def _default(value: Any) -> str:
    if value is None:
        return "none: must be given"
    if isinstance(value, float):
        return f"{value:g}"
    return f"`{value}`" if value != "" else "empty"


def renew(path: Path) -> str:
    """The text of the file with its tables made again."""
    return with_generated_section(path, MARKER, as_markdown(read_interfaces()))


if __name__ == "__main__":
    renew_file(renew)
