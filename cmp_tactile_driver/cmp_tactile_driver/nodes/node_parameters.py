"""Declares the fields of a parameter dataclass as parameters of a node."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from typing import TypeVar

from rclpy.node import Node

from cmp_tactile_processing.nodes.stage_parameters import declare_checked, describe

__all__ = ["declare_parameters"]

T = TypeVar("T")


def declare_parameters(node: Node, defaults: T, dynamic: Collection[str] = ()) -> T:
    """The dataclass with the values that the node was started with.

    All but `dynamic` are read-only.  Raises ParameterError for a value that the class refuses.
    """
    values = {
        item.name: declare_checked(
            node,
            item.name,
            getattr(defaults, item.name),
            describe(item, read_only=item.name not in dynamic),
        )
        for item in fields(defaults)  # type: ignore[arg-type]
    }
    return type(defaults)(**values)
