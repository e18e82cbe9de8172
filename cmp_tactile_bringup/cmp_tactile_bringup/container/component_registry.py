"""Finds component classes by their plugin name, through Python entry points."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from rclpy.node import Node

from cmp_tactile_bringup.errors import ComponentLoadError

__all__ = ["ENTRY_POINT_GROUP", "ComponentClass", "ComponentLookup", "find_component"]

ENTRY_POINT_GROUP = "cmp_tactile_components"

ComponentClass = type[Node]
"""Built as cls(cli_args=..., use_global_arguments=False, parameter_overrides=...)."""

ComponentLookup = Callable[[str, str], ComponentClass]
"""From package and plugin name to the class; raises ComponentLoadError where there is none."""


def find_component(package: str, plugin: str) -> ComponentClass:
    """The class that `package` registers as `plugin` in the group cmp_tactile_components.

    Raises ComponentLoadError, which lists the known plugins, or names why the import failed.
    """
    if plugin.partition("::")[0] != package:
        msg = f"found package {package!r}, expected the one in the plugin's name {plugin!r}"
        raise ComponentLoadError(msg)
    known = entry_points(group=ENTRY_POINT_GROUP)
    matches = [point for point in known if point.name == plugin]
    if not matches:
        names = ", ".join(sorted({point.name for point in known})) or "none"
        msg = f"found no installed component {plugin!r}, expected one of: {names}"
        raise ComponentLoadError(msg)
    try:
        found: Any = matches[0].load()
    except Exception as error:
        msg = f"{matches[0].value} cannot be imported: {type(error).__name__}: {error}"
        raise ComponentLoadError(msg) from error
    if not (isinstance(found, type) and issubclass(found, Node)):
        msg = f"{matches[0].value} is {found!r}, expected a class derived from rclpy's Node"
        raise ComponentLoadError(msg)
    return found
