"""What the keys of a file may hold, declared once: with the fields of the dataclass that they make.

The functions here make the `metadata` of such fields.  `read_fields` reads a section of a file by
them; ROS parameter descriptors and tables of the documentation are made of those of
`parameters.parameter`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Any, TypeVar

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.yaml_section import YamlSection

__all__ = [
    "choice",
    "field_values",
    "number",
    "part",
    "positive",
    "quantities",
    "read_by",
    "read_fields",
    "text",
    "texts",
    "whole",
]

Part = TypeVar("Part")
Metadata = Mapping[str, Any]


def read_by(
    read: Callable[[YamlSection, str], Any], key: str = "", *, required: bool = False
) -> Metadata:
    """Of a field that `read` reads from a section and a key.

    Parameters
    ----------
    read
        Raises DescriptionError for what the key may not hold.
    key
        In the file, where it is not the field's name.
    required
        That the file has the key, even though the field has a default.
    """
    return {"read": read, "key": key, "required": required}


def whole(low: int, high: int, **more: Any) -> Metadata:
    """A whole number, low <= number <= high; `more` as `read_by`, for all that follow."""
    return read_by(lambda section, key: section.integer(key, low, high), **more)


def number(low: float = -math.inf, high: float = math.inf, unit: str = "", **more: Any) -> Metadata:
    """A finite number, low <= number <= high."""
    if unit:
        return read_by(lambda section, key: section.quantity(key, unit, low, high), **more)
    return read_by(lambda section, key: section.number(key, low, high), **more)


def positive(high: float = math.inf, **more: Any) -> Metadata:
    """A finite number, 0 < number <= high."""
    return read_by(lambda section, key: section.positive(key, high), **more)


def quantities(count: int, limits: tuple[float, float], unit: str, **more: Any) -> Metadata:
    """So many numbers, each within the limits."""
    return read_by(lambda section, key: section.quantities(key, unit, (limits,) * count), **more)


def choice(*words: str, **more: Any) -> Metadata:
    """One of the words."""
    return read_by(lambda section, key: section.choice(key, words), **more)


def text(**more: Any) -> Metadata:
    """A text that is not empty."""
    return read_by(YamlSection.text, **more)


def texts(**more: Any) -> Metadata:
    """A list of such texts, which may be empty."""
    return read_by(YamlSection.texts, **more)


def part(kind: type[Any], **more: Any) -> Metadata:
    """A mapping that makes another dataclass of such fields."""
    return read_by(lambda section, key: read_fields(section.section(key), kind), **more)


def read_fields(section: YamlSection, kind: type[Part], **given: Any) -> Part:
    """The dataclass of all keys of a section.

    given: values of the fields that are not read here.
    Raises DescriptionError for a key that is absent, wrong, or none of the fields'.
    """
    values = field_values(section, kind, **given)
    section.finish()
    try:
        return kind(**values)
    except ParameterError as error:
        # It names the section and the key already.
        raise section.refused(error) from None


def field_values(section: YamlSection, kind: type[Any], **given: Any) -> dict[str, Any]:
    """Values by field, for a dataclass that is made of more than them; else as `read_fields`."""
    values = dict(given)
    for item in fields(kind):
        if item.name in given or "read" not in item.metadata:
            continue
        key = item.metadata["key"] or item.name
        default = item.default is not MISSING or item.default_factory is not MISSING
        if key in section or item.metadata["required"] or not default:
            values[item.name] = item.metadata["read"](section, key)
    return values
