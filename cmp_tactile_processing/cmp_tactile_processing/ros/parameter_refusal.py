"""Why parameters cannot be set, said with their names, what was found and what is expected."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, ParameterType, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from cmp_tactile_processing.ros.parameter_descriptors import allowed, unit_of

__all__ = ["TellingNode", "unknown_overrides", "why_refused"]

TYPES = {
    ParameterType.PARAMETER_BOOL: "true or false",
    ParameterType.PARAMETER_INTEGER: "an integer",
    ParameterType.PARAMETER_DOUBLE: "a number with a decimal point",
    ParameterType.PARAMETER_STRING: "a text",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "numbers with a decimal point",
}


class TellingNode(Node):
    """Stands before Node or LifecycleNode among the bases; its refusals tell why.

    rclpy refuses the same, but names types by number and neither the parameter of a wrong type nor
    the one that is unknown.
    """

    def set_parameters_atomically(
        self, parameter_list: list[Parameter[Any]]
    ) -> SetParametersResult:
        """As Node's; the services of the node set parameters by this."""
        for parameter in parameter_list:
            reason = why_refused(self, parameter)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(parameter_list)


def why_refused(node: Node, parameter: Parameter[Any]) -> str:
    """What is wrong with a parameter by itself; empty where nothing is, or a callback may say."""
    name, found = parameter.name, parameter.value
    if not node.has_parameter(name):
        return _unknown(node, name)
    descriptor = node.describe_parameter(name)
    if descriptor.read_only:
        return f"{name}: found {found!r}, expected nothing: it is fixed at the start"
    same_type = descriptor.dynamic_typing or parameter.type_.value == descriptor.type
    if same_type and _within(descriptor, found):
        return ""
    kind = TYPES.get(descriptor.type, "another type")
    expected = f"{allowed(descriptor)} {unit_of(descriptor)}".strip()
    if not same_type:
        expected = ", ".join(filter(None, (kind, expected)))
    return f"{name}: found {_plain(found)!r}, expected {expected}"


def unknown_overrides(node: Node) -> list[str]:
    """Parameters that were given at the start, by file or argument, and that the node has not.

    ROS lets them be, so that a name that is spelled wrongly does nothing and tells nothing.  For
    after all parameters were declared.
    """
    given = sorted(node._parameter_overrides)  # noqa: SLF001  rclpy tells them in no other way
    return [_unknown(node, name) for name in given if not node.has_parameter(name)]


def _unknown(node: Node, name: str) -> str:
    meant = get_close_matches(name, node.get_parameters_by_prefix(""), 1)
    return f"{name}: no such parameter" + (f"; did you mean {meant[0]}?" if meant else "")


def _within(descriptor: ParameterDescriptor, found: Any) -> bool:
    # NaN is not within either.
    bounds = [*descriptor.floating_point_range, *descriptor.integer_range]
    return all(item.from_value <= found <= item.to_value for item in bounds)


def _plain(found: Any) -> Any:
    return found if isinstance(found, (bool, int, float, str, type(None))) else list(found)
