"""Calls services of nodes that run, by names and values that people type."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from importlib import import_module
from typing import Any, TypeVar

import yaml
from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import GetParameterTypes, ListParameters, SetParametersAtomically
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import get_parameter_value

from cmp_tactile_processing.errors import CmpTactileError, found_text
from cmp_tactile_processing.sensor.yaml_file import did_you_mean

SERVICE_S, ANSWER_S = 1.0, 30.0
# Nodes come one after another: what was found is all once nothing new came for the second of these.
SEARCH_S, SETTLED_S = 5.0, 0.5
POLL_S = 0.02
SET_PARAMETERS = "/set_parameters"
# Types of ROS's own services, and names of parameters: seldom wanted, and not listed.
OF_ROS = (
    "rcl_interfaces/",
    "type_description_interfaces/",
    "lifecycle_msgs/",
    "composition_interfaces/",
)
LEFT_OUT = ("qos_overrides.", "start_type_description_service")

# Where nothing at all is found.
RUNNING_NODES = "running nodes; is ROS_DOMAIN_ID the same?"

T = TypeVar("T")


def answer_of(
    node: Node, kind: Any, service: str, request: Any, *, service_s: float = SERVICE_S
) -> Any:
    """The answer of a service, for a thread that does not spin the node.

    service_s: how long to wait for the service.
    Raises CmpTactileError where it is not there, or does not answer.
    """
    client = node.create_client(kind, service)
    try:
        if not client.wait_for_service(service_s):
            msg = f"{service}: found no such service; is the sensor running?"
            raise CmpTactileError(msg)
        future = client.call_async(request)
        end = time.monotonic() + ANSWER_S
        while not future.done():
            if time.monotonic() > end:
                msg = f"{service}: no answer within {ANSWER_S:g} s"
                raise CmpTactileError(msg)
            time.sleep(POLL_S)
        return future.result()
    finally:
        node.destroy_client(client)


def settled(ask: Callable[[], T], search_s: float = SEARCH_S, settled_s: float = SETTLED_S) -> T:
    """What `ask` returns once that is not empty and stays the same, or when the time is up."""
    now = begin = since = time.monotonic()
    answer = ask()
    while now - begin < search_s and not (answer and now - since > settled_s):
        time.sleep(POLL_S)
        now, before = time.monotonic(), answer
        answer = ask()
        since = since if answer == before else now
    return answer


def find_service(node: Node, name: str) -> tuple[str, str]:
    """Full name and type of the only service of that name, or whose name ends so.

    That of a node stands for its parameters.
    Raises CmpTactileError, with what there is, for none and for several.
    """
    ends = f"/{name.strip('/')}"

    def called_so() -> dict[str, str]:
        offered = _offered(node)
        for wanted in (ends, ends + SET_PARAMETERS):
            if wanted in offered:
                return {wanted: offered[wanted]}
        return {
            full: kind
            for full, kind in offered.items()
            if not name.startswith("/") and full.endswith((ends, ends + SET_PARAMETERS))
        }

    found = settled(called_so)
    if len(found) > 1:
        named = ", ".join(full.removesuffix(SET_PARAMETERS) for full in sorted(found))
        msg = f"{name}: found several, expected the name of one of: {named}"
        raise CmpTactileError(msg)
    if not found:
        there = sorted(k for k, kind in _offered(node).items() if not kind.startswith(OF_ROS))
        expected = f"one of {', '.join(there)}" if there else RUNNING_NODES
        msg = f"{name}: found no such service, expected {expected}{did_you_mean_end(ends, there)}"
        raise CmpTactileError(msg)
    return next(iter(found.items()))


def did_you_mean_end(ends: str, there: Iterable[str]) -> str:
    """A question after the name that is like what was typed, by as many parts at its end."""
    count = ends.count("/")
    return did_you_mean(ends, ["/" + "/".join(full.split("/")[-count:]) for full in there])


def _offered(node: Node) -> dict[str, str]:
    """Services that nodes have, with their types; not those that somebody only waits for."""
    offered: dict[str, str] = {}
    for owner, space in node.get_node_names_and_namespaces():
        if (owner, space) == (node.get_name(), node.get_namespace()):
            continue
        with suppress(NodeNameNonExistentError):  # it has gone meanwhile
            services = node.get_service_names_and_types_by_node(owner, space)
            offered.update((full, kinds[0]) for full, kinds in services)
    return offered


def call(node: Node, service: str, kind: str, words: Iterable[str]) -> Any:
    """The answer to fields, or to parameters of a node, that are typed as NAME:=VALUE.

    service, kind: as `find_service` returns them.  Raises CmpTactileError where one does not fit.
    """
    owner = service.removesuffix(SET_PARAMETERS)
    if owner != service:
        return _set_parameters(node, owner, _values(words))
    loaded = interface_of(kind, service)
    request = loaded.Request(check_fields=True)
    for field, text in _values(words).items():
        _set_field(request, field, text)
    return answer_of(node, loaded, service, request, service_s=SEARCH_S)


def interface_of(kind: str, user: str) -> Any:
    """The class of a message or service type, as std_msgs/msg/String.

    user: service or topic that has it.  Raises CmpTactileError where the type is not installed.
    """
    package, _, name = kind.rpartition("/")
    try:
        return getattr(import_module(package.replace("/", ".")), name)
    except (ImportError, AttributeError):
        msg = f"{user}: found the type {kind}, which is not installed here"
        raise CmpTactileError(msg) from None


def _values(words: Iterable[str]) -> dict[str, str]:
    values = {}
    for word in words:
        name, separator, text = word.partition(":=")
        if not separator:
            msg = f"found {word!r}, expected NAME:=VALUE"
            raise CmpTactileError(msg)
        values[name] = text
    return values


def _set_field(request: Any, field: str, text: str) -> None:
    kinds = request.get_fields_and_field_types()
    if field not in kinds:
        there = ", ".join(f"{name} ({kind})" for name, kind in kinds.items()) or "no field"
        msg = f"found no field {field!r}, expected {there}{did_you_mean(field, kinds)}"
        raise CmpTactileError(msg)
    try:
        value = text if kinds[field].startswith("string") else yaml.safe_load(text)
        if kinds[field] in ("float", "double"):
            value = float(value)
        setattr(request, field, value)
    except (AssertionError, TypeError, ValueError, yaml.YAMLError):
        msg = f"{field}: found {found_text(text)}, expected {kinds[field]}"
        raise CmpTactileError(msg) from None


def _set_parameters(node: Node, owner: str, values: Mapping[str, str]) -> Any:
    """The result; none is set where one is refused."""
    asked = ListParameters.Request()
    listed = answer_of(node, ListParameters, f"{owner}/list_parameters", asked, service_s=SEARCH_S)
    known = sorted(name for name in listed.result.names if not name.startswith(LEFT_OUT))
    for name in values or ("",):
        if name not in listed.result.names:
            msg = f"{owner}: found no parameter {name!r}, expected one of {', '.join(known)}"
            raise CmpTactileError(msg + did_you_mean(name, known))
    request = GetParameterTypes.Request(names=list(values))
    kinds = answer_of(node, GetParameterTypes, f"{owner}/get_parameter_types", request).types
    given = [
        Parameter(name=name, value=_parameter_value(text, kind))
        for (name, text), kind in zip(values.items(), kinds, strict=True)
    ]
    change = SetParametersAtomically.Request(parameters=given)
    service = f"{owner}/set_parameters_atomically"
    return answer_of(node, SetParametersAtomically, service, change).result


def _parameter_value(text: str, kind: int) -> Any:
    """As `ros2 param set` reads it; but 4 is a real number, and yes a string, where one is held."""
    value = get_parameter_value(text)
    if kind == ParameterType.PARAMETER_DOUBLE and value.type == ParameterType.PARAMETER_INTEGER:
        value.type, value.double_value = kind, float(value.integer_value)
    elif kind == ParameterType.PARAMETER_STRING:
        value.type, value.string_value = kind, text
    return value
