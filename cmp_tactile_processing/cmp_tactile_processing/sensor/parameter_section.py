"""Reads a section of a file as one of the dataclasses of parameters."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, did_you_mean

__all__ = ["read_parameters"]

Parameters = TypeVar("Parameters")


def read_parameters(section: YamlSection | None, kind: type[Parameters]) -> Parameters:
    """The parameters of a section, whose keys are the fields of `kind`; its defaults for None.

    Raises DescriptionError for keys that are no fields and for values out of range.
    """
    if section is None:
        return kind()
    known = {item.name: item for item in dataclasses.fields(kind)}  # type: ignore[arg-type]
    values = {key: _as_meant(section.raw(key), known[key]) for key in known if key in section}
    for key, value in section.items():
        if key not in known:
            expected = f"no such key; allowed: {', '.join(sorted(known))}{did_you_mean(key, known)}"
            raise section.error(key, value, expected)
    try:
        return kind(**values)
    except ParameterError as error:
        # It names the section and the key already.
        raise section.refused(error) from None


def _as_meant(value: object, item: dataclasses.Field[Any]) -> Any:
    """The value; YAML takes on and off without quotes for true and false."""
    word = "on" if value is True else "off"
    return word if isinstance(value, bool) and word in item.metadata["choices"] else value
