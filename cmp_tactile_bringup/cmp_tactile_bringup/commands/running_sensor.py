"""The sensor that runs in other processes, which a command means."""

from __future__ import annotations

from dataclasses import dataclass

from rcl_interfaces.srv import GetParameters
from rclpy.node import Node

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.services import ServiceError, answer_of, settled

SPLITTER = "view_splitter"
SEARCH_TIME_S = 5.0


class RunningSensorError(CmpTactileError):
    """No sensor runs, or several do where one is meant."""


@dataclass(frozen=True)
class RunningSensor:
    """A sensor's namespace, and the parameters of its nodes; empty where they do not answer."""

    namespace: str
    description: str = ""
    name: str = ""


def find_sensor(node: Node, namespace: str = "") -> RunningSensor:
    """The sensor of a namespace, or of one of its topics, or the only one that runs.

    node: with which it is looked for; it is spun by another thread.  Waits some seconds.  Raises
    RunningSensorError where there is none, or several.
    """
    wanted = f"/{namespace.strip('/')}" if namespace else ""
    spaces = settled(lambda: _namespaces(node, wanted), SEARCH_TIME_S)
    if not spaces:
        where = f"in {wanted}" if wanted else "in any namespace"
        there = ", ".join(_namespaces(node, "")) or "a running sensor; is ROS_DOMAIN_ID the same?"
        msg = f"found no {SPLITTER} {where}, expected {there}"
        raise RunningSensorError(msg)
    if len(spaces) > 1:
        msg = f"found several sensors, expected the namespace of one of: {', '.join(spaces)}"
        raise RunningSensorError(msg)
    return _described(node, spaces[0])


def _namespaces(node: Node, wanted: str) -> list[str]:
    """Those of all sensors, or that in which what is wanted lies."""
    found = {space for name, space in node.get_node_names_and_namespaces() if name == SPLITTER}
    if not wanted:
        return sorted(found)
    around = [space for space in found if space == wanted or wanted.startswith(f"{space}/")]
    return sorted(around, key=len)[-1:]


def _described(node: Node, namespace: str) -> RunningSensor:
    request = GetParameters.Request(names=["sensor_description", "sensor_name"])
    service = f"{namespace.rstrip('/')}/{SPLITTER}/get_parameters"
    try:
        answer = answer_of(node, GetParameters, service, request, service_s=SEARCH_TIME_S)
    except ServiceError:
        return RunningSensor(namespace)
    return RunningSensor(namespace, *(value.string_value for value in answer.values))
