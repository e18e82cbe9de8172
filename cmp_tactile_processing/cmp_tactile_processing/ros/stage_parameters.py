"""ROS parameters of a stage, made from the fields of its parameter dataclass."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from cmp_tactile_processing.errors import CmpTactileError, ParameterError
from cmp_tactile_processing.ros.parameter_descriptors import allowed, describe

__all__ = ["StageParameters", "declare_checked", "describe"]

T = TypeVar("T")

TYPE_TEXT = {
    bool: "true or false",
    int: "an integer",
    float: "a number with a decimal point",
    str: "a text",
}


class StageParameters(Generic[T]):
    """The parameters of a stage as the node's: `value` is the dataclass with all of them.

    defaults: the dataclass instance to start from.  on_change is called with the new instance
    after a parameter was set; without it the parameters are read-only.  A value that the
    dataclass does not take is refused with its reason, at start by ParameterError.
    section: where a node has the parameters of two stages, what comes before the names of one of
    them, as in `slip.min_normal_force`.
    """

    def __init__(
        self,
        node: Node,
        defaults: T,
        on_change: Callable[[T], object] | None = None,
        section: str = "",
    ) -> None:
        self._node = node
        self._on_change = on_change
        found: dict[str, Any] = {}
        for item in fields(defaults):  # type: ignore[arg-type]
            descriptor = describe(item, read_only=on_change is None)
            # A file may say 1 where 1.0 is meant; a ROS parameter has one type for good.
            value = getattr(defaults, item.name)
            default = float(value) if isinstance(item.default, float) else value
            found[item.name] = declare_checked(node, _name(section, item.name), default, descriptor)
        self._fields = {_name(section, field): field for field in found}
        self.value: T = replace(defaults, **found)  # type: ignore[type-var]
        if on_change is not None:
            node.add_on_set_parameters_callback(self._check)
            node.add_post_set_parameters_callback(self._apply)

    def _with(self, parameters: list[Parameter[Any]]) -> T:
        changes = {self._fields[p.name]: p.value for p in parameters if p.name in self._fields}
        return replace(self.value, **changes)  # type: ignore[type-var]

    def _check(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        try:
            self._with(parameters)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter[Any]]) -> None:
        value = self._with(parameters)
        if value != self.value and self._on_change is not None:
            self.value = value
            try:
                self._on_change(value)
            except CmpTactileError as error:
                self._node.get_logger().error(f"new parameters cannot be used: {error}")
            except Exception:  # noqa: BLE001  it must not end the node
                text = f"unexpected error by new parameters\n{traceback.format_exc()}"
                self._node.get_logger().error(text)


def _name(section: str, field: str) -> str:
    return f"{section}.{field}" if section else field


def declare_checked(node: Node, name: str, default: Any, descriptor: ParameterDescriptor) -> Any:
    """Declare a parameter and return its value.

    Raises ParameterError for a value of the wrong type or outside its range.
    """
    try:
        return node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, InvalidParameterValueException):
        # The exceptions tell the value only within a text of their own.
        override = node._parameter_overrides.get(name)  # noqa: SLF001
        found = default if override is None else override.value
        expected = _expected(default, descriptor, same_type=type(found) is type(default))
        msg = (
            f"{node.get_fully_qualified_name()}: parameter {name}: "
            f"found {found!r}, expected {expected}"
        )
        raise ParameterError(msg) from None


def _expected(default: Any, descriptor: ParameterDescriptor, *, same_type: bool) -> str:
    """The range or choice; before it the type, where that is what is wrong."""
    limits = allowed(descriptor)
    kind = TYPE_TEXT.get(type(default), f"a value like {default!r}")
    return limits if same_type and limits else ", ".join(filter(None, (kind, limits)))
