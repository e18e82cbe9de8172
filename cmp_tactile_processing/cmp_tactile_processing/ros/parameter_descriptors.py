"""Descriptors of ROS parameters: range, choice and unit, made from dataclass fields and read."""

from __future__ import annotations

import re
from dataclasses import Field
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from cmp_tactile_processing.sensor.parameters import numbers_text

__all__ = ["allowed", "describe", "unit_of", "with_unit"]


def describe(item: Field[Any], *, read_only: bool) -> ParameterDescriptor:
    """The descriptor of a field made by `parameters.parameter`."""
    meta = item.metadata
    low, high, choices = meta["low"], meta["high"], meta["choices"]
    descriptor = ParameterDescriptor(
        description=with_unit(meta["description"], meta["unit"]), read_only=read_only
    )
    if isinstance(item.default, tuple):
        descriptor.additional_constraints = numbers_text(item.default, meta)
    elif choices:
        descriptor.additional_constraints = "one of " + ", ".join(choices)
    elif low is not None and high is not None:
        if isinstance(item.default, int):
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            bounds = FloatingPointRange(from_value=float(low), to_value=float(high))
            descriptor.floating_point_range = [bounds]
    elif low is not None:
        descriptor.additional_constraints = f"at least {low}"
    elif high is not None:
        descriptor.additional_constraints = f"at most {high}"
    return descriptor


def with_unit(description: str, unit: str) -> str:
    """A parameter's description, which ends in its unit: ROS has no other place for it."""
    return f"{description} [{unit}]" if unit else description


def unit_of(descriptor: ParameterDescriptor) -> str:
    """The unit that a description ends in, empty for a number without one."""
    found = re.search(r" \[([^\[\]]+)\]$", descriptor.description)
    return found.group(1) if found else ""


def allowed(descriptor: ParameterDescriptor) -> str:
    """The range or choice of a descriptor, empty where it has none."""
    bounds = [*descriptor.floating_point_range, *descriptor.integer_range]
    limits = [f"{item.from_value:g} to {item.to_value:g}" for item in bounds]
    limits += [descriptor.additional_constraints] if descriptor.additional_constraints else []
    return ", ".join(limits)
