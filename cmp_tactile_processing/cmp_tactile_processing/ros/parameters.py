"""ROS parameters made from dataclasses: descriptors, values at the start, changes, refusals."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Collection
from dataclasses import Field, dataclass, fields, replace
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from cmp_tactile_processing.errors import CmpTactileError, InputError
from cmp_tactile_processing.sensor.description import DEFAULT_SENSOR, SENSOR_NAME_HELP
from cmp_tactile_processing.sensor.parameters import Parameters, numbers_text, parameter
from cmp_tactile_processing.sensor.yaml_file import did_you_mean

TYPES = {
    ParameterType.PARAMETER_BOOL: "true or false",
    ParameterType.PARAMETER_INTEGER: "an integer",
    ParameterType.PARAMETER_DOUBLE: "a number with a decimal point",
    ParameterType.PARAMETER_STRING: "a text",
    ParameterType.PARAMETER_DOUBLE_ARRAY: "numbers with a decimal point",
}

T = TypeVar("T")


def describe(item: Field[Any], *, read_only: bool) -> ParameterDescriptor:
    """The descriptor of a field made by `parameters.parameter`."""
    meta = item.metadata
    low, high, choices = meta["low"], meta["high"], meta["choices"]
    descriptor = ParameterDescriptor(description=meta["description"], read_only=read_only)
    constraints = [f"in {meta['unit']}"] if meta["unit"] else []
    if isinstance(item.default, tuple):
        constraints.insert(0, numbers_text(item.default, meta))
    elif choices:
        constraints = ["one of " + ", ".join(choices)]
    elif low is not None and high is not None:
        if isinstance(item.default, int):
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
            descriptor.floating_point_range = [bounds]
    elif low is not None:
        constraints.insert(0, f"at least {low}")
    elif high is not None:
        constraints.insert(0, f"at most {high}")
    # ROS has no other place for the unit.
    descriptor.additional_constraints = ", ".join(constraints)
    return descriptor


def allowed(descriptor: ParameterDescriptor) -> str:
    """The range or choice of a descriptor, and its unit; empty where it has none."""
    bounds = [*descriptor.floating_point_range, *descriptor.integer_range]
    limits = [f"{item.from_value:g} to {item.to_value:g}" for item in bounds]
    limits += [descriptor.additional_constraints] if descriptor.additional_constraints else []
    return ", ".join(limits)


def why_refused(node: Node, parameter: Parameter[Any]) -> str:
    """Why a name or a type is refused, which rclpy does not say by name; empty where neither is."""
    if not node.has_parameter(parameter.name):
        return _unknown(node, parameter.name)
    descriptor = node.describe_parameter(parameter.name)
    if descriptor.read_only or parameter.type_.value == descriptor.type:
        return ""
    expected = _expected(descriptor, descriptor.type)
    return f"{parameter.name}: found {_plain(parameter.value)!r}, expected {expected}"


def _expected(descriptor: ParameterDescriptor, kind: int) -> str:
    return ", ".join(filter(None, (TYPES.get(kind, "another type"), allowed(descriptor))))


def unknown_overrides(node: Node) -> list[str]:
    """Parameters that were given at the start, by file or argument, and that the node has not.

    ROS lets them be, so that a name that is spelled wrongly does nothing, silently.  For
    after all parameters were declared.
    """
    given = sorted(node._parameter_overrides)  # noqa: SLF001  rclpy has no other access
    return [_unknown(node, name) for name in given if not node.has_parameter(name)]


def _unknown(node: Node, name: str) -> str:
    return f"{name}: no such parameter{did_you_mean(name, node.get_parameters_by_prefix(''))}"


def _plain(found: Any) -> Any:
    return found if isinstance(found, (bool, int, float, str, type(None))) else list(found)


class StageParameters(Generic[T]):
    """The parameters of a stage as the node's: `value` is the dataclass with all of them.

    defaults: the dataclass instance to start from.  on_change is called with the new instance
    after a parameter was set.  A value that the dataclass does not take is refused with its reason,
    at start by InputError.
    section: where a node has the parameters of two stages, what comes before the names of one of
    them, as in `slip.min_normal_force`.
    """

    def __init__(
        self, node: Node, defaults: T, on_change: Callable[[T], object], section: str = ""
    ) -> None:
        self._node, self._on_change = node, on_change
        names = [item.name for item in fields(defaults)]  # type: ignore[arg-type]
        self._fields = {_full_name(section, name): name for name in names}
        self.value: T = declare_parameters(node, defaults, names, section)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _with(self, parameters: list[Parameter[Any]]) -> T:
        changes = {
            self._fields[p.name]: _of_class(p.value) for p in parameters if p.name in self._fields
        }
        return replace(self.value, **changes)  # type: ignore[type-var]

    def _check(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        try:
            self._with(parameters)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter[Any]]) -> None:
        value = self._with(parameters)
        if value == self.value:
            return
        self.value = value
        try:
            self._on_change(value)
        except CmpTactileError as error:
            self._node.get_logger().error(f"the new parameters cannot be used: {error}")
        except Exception:  # noqa: BLE001  it must not end the node
            text = f"unexpected error by new parameters\n{traceback.format_exc()}"
            self._node.get_logger().error(text)


def _of_class(value: Any) -> Any:
    """ROS has lists and arrays where a frozen dataclass has tuples."""
    value = _plain(value)
    return tuple(value) if isinstance(value, list) else value


def _full_name(section: str, field: str) -> str:
    return f"{section}.{field}" if section else field


def declare_parameters(
    node: Node, defaults: T, dynamic: Collection[str] = (), section: str = ""
) -> T:
    """The dataclass with the values that the node was started with.

    All but `dynamic` are read-only.  section: what comes before the names.  Raises InputError
    for a value that the class refuses.
    """
    values = {}
    for item in fields(defaults):  # type: ignore[arg-type]
        value = getattr(defaults, item.name)
        # A file may say 1 where 1.0 is meant; a ROS parameter has one type for good.
        default = float(value) if isinstance(item.default, float) else _plain(value)
        descriptor = describe(item, read_only=item.name not in dynamic)
        declared = declare_checked(node, _full_name(section, item.name), default, descriptor)
        values[item.name] = _of_class(declared)
    try:
        return type(defaults)(**values)
    except InputError as error:
        msg = f"{node.get_fully_qualified_name()}: {error}"
        raise InputError(msg) from None


def declare_checked(node: Node, name: str, default: Any, descriptor: ParameterDescriptor) -> Any:
    """Declare a parameter and return its value.

    Raises InputError for a value of the wrong type or outside its range.
    """
    try:
        return node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException):
        # The exceptions have the value only within a text of their own.
        override = node._parameter_overrides.get(name)  # noqa: SLF001
        found = default if override is None else override.value
        expected = _expected(descriptor, Parameter.Type.from_parameter_value(default).value)
        msg = (
            f"{node.get_fully_qualified_name()}: parameter {name}: "
            f"found {found!r}, expected {expected}"
        )
        raise InputError(msg) from None


@dataclass(frozen=True)
class SensorParameters(Parameters):
    """Which sensor a node is of."""

    sensor_description: str = parameter(
        DEFAULT_SENSOR, "sensor description: a file or a packaged name"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)


@dataclass(frozen=True)
class ImageInputParameters(Parameters):
    """How a node subscribes to images."""

    reliable_input: bool = parameter(
        True, "subscribe to images reliably; a best-effort publisher does not match"
    )
