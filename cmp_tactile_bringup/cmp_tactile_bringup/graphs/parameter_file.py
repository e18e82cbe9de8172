"""ROS parameter files: which parameters they set on which nodes.

/**:                       # any node; * stands for one part of a name
  ros__parameters: {use_sim_time: true}
left_finger:
  view_splitter:
    ros__parameters: {reliable_input: false}
/**/force_reconstructor:
  ros__parameters: {slip: {full_ratio: 0.8}}
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.arguments import Value
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import YamlSection, read_yaml

__all__ = ["parameters_of_nodes"]

PARAMETERS = "ros__parameters"


def parameters_of_nodes(path: Path, full_names: Sequence[str]) -> dict[str, dict[str, Value]]:
    """Parameters by the full name of their node; what stands further down takes precedence.

    Raises GraphError for a file that cannot be used, and for an entry that fits none of the nodes.
    """
    try:
        entries = list(_entries(read_yaml(path), ""))
    except DescriptionError as error:
        raise GraphError(str(error)) from None
    found: dict[str, dict[str, Value]] = {}
    for pattern, parameters in entries:
        nodes = [name for name in full_names if _expression(pattern).fullmatch(name)]
        if not nodes:
            names = ", ".join(full_names)
            msg = f"{path}: found parameters of {pattern}, expected those of one of {names}"
            raise GraphError(msg)
        for name in nodes:
            found.setdefault(name, {}).update(parameters)
    return found


def _entries(section: YamlSection, above: str) -> Iterator[tuple[str, dict[str, Value]]]:
    for key, value in section.items():
        if key == PARAMETERS:
            inner = section.section(key)
            yield above or "/**", dict(_flat(inner, ""))
        elif not isinstance(value, dict):
            raise section.error(key, value, f"a mapping with {PARAMETERS}")
        else:
            yield from _entries(section.section(key), f"{above}/{key.strip('/')}")


def _flat(section: YamlSection, prefix: str) -> Iterator[tuple[str, Value]]:
    """Parameters with those of nested mappings as `outer.inner`."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _flat(section.section(key), f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", _checked(section, key, value)


def _checked(section: YamlSection, key: str, value: Any) -> Value:
    kinds = {type(item) for item in value} if isinstance(value, list) else {type(value)}
    if len(kinds) == 1 and kinds <= {bool, int, float, str}:
        return value
    raise section.error(key, value, "a boolean, number, text or list of one kind")


def _expression(pattern: str) -> re.Pattern[str]:
    """`/**` stands for any parts of a name, `*` for one."""
    text = re.escape(pattern)
    return re.compile(text.replace(r"/\*\*", "(?:/[^/]+)*").replace(r"\*", "[^/]+"))
