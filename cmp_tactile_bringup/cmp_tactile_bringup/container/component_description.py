"""What a component is loaded with, and the constructor arguments that come of it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.logging import LoggingSeverity
from rclpy.parameter import Parameter

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graphs.description import ROS_NAME, ROS_NAMESPACE, Component

__all__ = ["ComponentDescription"]

LOG_LEVELS = tuple(int(level) for level in LoggingSeverity)
REMAP_RULE = re.compile(r"\S+:=\S+")


@dataclass(frozen=True)
class ComponentDescription:
    """A component to load: the fields of composition_interfaces/LoadNode.

    package, plugin: as in the entry point `package::Class`.  name, namespace: empty for the
    component's own.  remappings: rules `from:=to`.  log_level: a constant of rcl_interfaces/Log,
    0 for the default.  intra_process: whether messages are handed over to the other components.
    """

    package: str
    plugin: str
    name: str = ""
    namespace: str = ""
    remappings: tuple[str, ...] = ()
    parameters: tuple[Parameter[Any], ...] = ()
    log_level: int = 0
    intra_process: bool = True

    @classmethod
    def from_graph(cls, component: Component) -> ComponentDescription:
        """The description of a component of a graph file."""
        return cls(
            package=component.package,
            plugin=component.plugin,
            name=component.name,
            namespace=component.namespace,
            remappings=tuple(f"{old}:={new}" for old, new in component.remappings.items()),
            parameters=tuple(
                Parameter(name, value=value) for name, value in component.parameters.items()
            ),
        )

    @property
    def full_name(self) -> str:
        """Namespace and name; empty for the component's own name."""
        namespace = f"/{self.namespace.strip('/')}".rstrip("/")
        return f"{namespace}/{self.name}" if self.name else ""

    def check(self) -> None:
        """Raise ComponentLoadError for what ROS would refuse in its own terms."""
        if self.log_level not in LOG_LEVELS:
            msg = f"log level: found {self.log_level}, expected one of {LOG_LEVELS}"
            raise ComponentLoadError(msg)
        letters = "letters, digits, single underscores"
        if self.name and not ROS_NAME.fullmatch(self.name):
            msg = f"node name: found {self.name!r}, expected {letters}"
            raise ComponentLoadError(msg)
        if not ROS_NAMESPACE.fullmatch(self.namespace):
            msg = f"namespace: found {self.namespace!r}, expected names of {letters}, joined by /"
            raise ComponentLoadError(msg)
        for rule in self.remappings:
            if not REMAP_RULE.fullmatch(rule):
                msg = f"remap rule: found {rule!r}, expected FROM:=TO without spaces"
                raise ComponentLoadError(msg)

    def node_arguments(self) -> dict[str, Any]:
        """Keyword arguments of the component's constructor.

        Without use_global_arguments=False a component that has no name of its own would take
        the container's.
        """
        rules = list(self._identity_rules())
        rules += self.remappings
        cli_args = ["--ros-args"] if rules else []
        for rule in rules:
            cli_args += ["-r", rule]
        return {
            "cli_args": cli_args,
            "use_global_arguments": False,
            "parameter_overrides": list(self.parameters),
        }

    def _identity_rules(self) -> Iterable[str]:
        if self.name:
            yield f"__node:={self.name}"
        if self.namespace:
            yield f"__ns:=/{self.namespace.lstrip('/')}"
