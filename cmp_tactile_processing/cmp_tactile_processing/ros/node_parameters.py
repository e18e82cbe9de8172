"""Parameters that are fixed when a node starts: dataclasses, and their declaration."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from rclpy.node import Node

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.ros.stage_parameters import declare_checked, describe
from cmp_tactile_processing.sensor.library import DEFAULT_SENSOR, SENSOR_NAME_HELP
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["ImageInputParameters", "SensorParameters", "declare_parameters"]

T = TypeVar("T")


@dataclass(frozen=True)
class SensorParameters:
    """Which sensor a node is of."""

    sensor_description: str = parameter(
        DEFAULT_SENSOR, "file of the sensor description, or name of a packaged one"
    )
    sensor_name: str = parameter("", SENSOR_NAME_HELP)

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True)
class ImageInputParameters:
    """How a node subscribes to images."""

    reliable_input: bool = parameter(
        True, "subscribe to images reliably, which a best-effort publisher does not match"
    )

    def __post_init__(self) -> None:
        check_parameters(self)


def declare_parameters(node: Node, defaults: T, dynamic: Collection[str] = ()) -> T:
    """The dataclass with the values that the node was started with.

    All but `dynamic` are read-only.  Raises ParameterError for a value that the class refuses.
    """
    values = {
        item.name: _declare(node, item, getattr(defaults, item.name), item.name not in dynamic)
        for item in fields(defaults)  # type: ignore[arg-type]
    }
    try:
        return type(defaults)(**values)
    except ParameterError as error:
        msg = f"{node.get_fully_qualified_name()}: {error}"
        raise ParameterError(msg) from None


def _declare(node: Node, item: Any, default: Any, read_only: bool) -> Any:
    """ROS has lists where a frozen dataclass has tuples."""
    descriptor = describe(item, read_only=read_only)
    if isinstance(default, tuple):
        return tuple(declare_checked(node, item.name, list(default), descriptor))
    return declare_checked(node, item.name, default, descriptor)
