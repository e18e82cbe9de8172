"""What a component is loaded with, and the constructor arguments that come of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.parameter import Parameter

from cmp_tactile_bringup.graph import Component

__all__ = ["ComponentDescription"]


@dataclass(frozen=True)
class ComponentDescription:
    """A component to load: the fields of composition_interfaces/LoadNode.

    package, plugin: as in the entry point `package::Class`.  name, namespace: empty for the
    component's own.  remappings: rules `from:=to`.  log_level: a constant of rcl_interfaces/Log,
    0 for the default.
    """

    package: str
    plugin: str
    name: str = ""
    namespace: str = ""
    remappings: tuple[str, ...] = ()
    parameters: tuple[Parameter[Any], ...] = ()
    log_level: int = 0

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
