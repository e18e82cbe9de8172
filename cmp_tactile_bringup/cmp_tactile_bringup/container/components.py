"""The component container: loads, unloads and lists components in this process."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from concurrent.futures import TimeoutError as LateError
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from rclpy.context import Context
from rclpy.logging import LoggingSeverity, get_logger, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from cmp_tactile_bringup.container.spinning import ComponentClass, LoadedComponent, Spinner
from cmp_tactile_bringup.errors import ComponentError, ComponentLoadError
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.process import spare_the_collector
from cmp_tactile_processing.ros.wiring import WiredNode

ENTRY_POINT_GROUP = "cmp_tactile_components"

ComponentLookup = Callable[[str, str], ComponentClass]
"""From package and plugin name to the class; raises ComponentLoadError where there is none."""

STOP_TIMEOUT = 4.0
"""How long a running callback may take to end, s; launch kills a process after 5 s."""


def find_component(package: str, plugin: str) -> ComponentClass:
    """The class that `package` registers as `plugin` in the group cmp_tactile_components.

    Raises ComponentLoadError, which lists the known plugins, or names why the import failed.
    """
    if plugin.partition("::")[0] != package:
        msg = f"found package {package!r}, expected the package in the plugin's name {plugin!r}"
        raise ComponentLoadError(msg)
    known = entry_points(group=ENTRY_POINT_GROUP)
    matches = [point for point in known if point.name == plugin]
    if not matches:
        names = ", ".join(sorted({point.name for point in known})) or "none"
        msg = f"found no installed component {plugin!r}, expected one of: {names}"
        raise ComponentLoadError(msg)
    try:
        found: Any = matches[0].load()
    except (Exception, SystemExit) as error:
        msg = f"{matches[0].value} cannot be imported: {type(error).__name__}: {error}"
        raise ComponentLoadError(msg) from error
    if not (isinstance(found, type) and issubclass(found, Node)):
        msg = f"{matches[0].value} is {found!r}, expected a class derived from rclpy's Node"
        raise ComponentLoadError(msg)
    return found


def node_arguments(component: Component) -> dict[str, Any]:
    """Keyword arguments of the component's constructor.

    Without use_global_arguments=False a component that has no name of its own would take the
    container's.
    """
    rules = [f"{old}:={new}" for old, new in component.remappings.items()]
    if component.namespace:
        rules.insert(0, f"__ns:=/{component.namespace.lstrip('/')}")
    if component.name:
        rules.insert(0, f"__node:={component.name}")
    parameters = [
        value if isinstance(value, Parameter) else Parameter(name, value=value)
        for name, value in component.parameters.items()
    ]
    remappings = [word for rule in rules for word in ("-r", rule)]
    return {
        "cli_args": ["--ros-args", *remappings] if rules else [],
        "use_global_arguments": False,
        "parameter_overrides": parameters,
    }


class ComponentContainer:
    """Runs components, those of a sensor connected with one another and on one thread.

    All methods may be called from any thread; one component is loaded or unloaded at a time.  The
    ROS context must be valid until `shutdown` returned; the container does not end it.
    context: that of all components.  threads_before: those that ran before the container.
    """

    def __init__(
        self, context: Context | None = None, lookup: ComponentLookup = find_component
    ) -> None:
        self.context = get_default_context() if context is None else context
        self.threads_before = frozenset(threading.enumerate())
        self._lookup = lookup
        self._lock = threading.Lock()
        self._components: dict[int, LoadedComponent] = {}
        self._spinners: dict[str, Spinner] = {}
        self._last_id = 0
        self._closed = False

    def load(self, component: Component) -> int:
        """Build a component and run it; returns its id once it runs.

        Raises ComponentLoadError with the reason, also where another component has the name.
        """
        with self._lock:
            try:
                return self._load(component)
            except ComponentLoadError as error:
                raise ComponentLoadError(f"{component.label}: {error}") from None

    def _load(self, component: Component) -> int:
        try:
            log_level = LoggingSeverity(component.log_level)
        except ValueError as error:
            msg = f"log level: {error}"
            raise ComponentLoadError(msg) from None
        found = self._lookup(component.package, component.plugin)
        arguments = node_arguments(component)
        if self.context is not get_default_context():
            arguments["context"] = self.context
        spinner = self._spinner_of(component, found)
        loaded = LoadedComponent(spinner)
        try:
            self._check_open()
            spinner.build(loaded, found, arguments)
            # ROS would let them share a name, and what is built now would hold up the end.
            self._check_name(loaded.full_name)
            self._check_open()
        except ComponentLoadError:
            self._stop(loaded, STOP_TIMEOUT)
            raise
        self._last_id += 1
        self._components[self._last_id] = loaded
        spinner.do(partial(spinner.add, loaded)).result()
        if component.log_level:
            set_logger_level(loaded.full_name.strip("/").replace("/", "."), log_level)
        spare_the_collector()
        return self._last_id

    def unload(self, unique_id: int, timeout: float = STOP_TIMEOUT) -> None:
        """Stop and destroy a component.

        Raises ComponentError for an unknown id, and where its running callback does not end
        within `timeout` s; the component is then gone as soon as that callback ends.
        """
        with self._lock:
            loaded = self._components.pop(unique_id, None)
            if loaded is None:
                known = ", ".join(map(str, self._components)) or "none"
                msg = f"no component has the id {unique_id}; loaded ids: {known}"
                raise ComponentError(msg)
            if not self._stop(loaded, timeout):
                msg = f"{loaded.full_name}: found a callback that still runs after {timeout} s"
                raise ComponentError(msg)

    def list(self) -> dict[int, LoadedComponent]:
        """The running components by id, in the order in which they were loaded."""
        return dict(self._components)

    def shutdown(self, timeout: float = STOP_TIMEOUT) -> None:
        """Stop and destroy all components; no more can be loaded.

        A callback or a constructor that still runs after `timeout` s is left behind, with a
        warning.
        """
        self._closed = True
        deadline = time.monotonic() + timeout
        for spinner in {item.spinner for item in self._components.values()}:
            spinner.end()
        late = [
            item.full_name
            for item in self._components.values()
            if not item.spinner.join(max(0.0, deadline - time.monotonic()))
        ]
        if self._lock.acquire(timeout=max(0.0, deadline - time.monotonic())):
            self._components.clear()
            self._lock.release()
        else:
            late.append("a component that is being built")
        if late:
            message = f"still busy after {timeout} s; not waited for any longer: {', '.join(late)}"
            get_logger("component_container").warning(message)

    def _spinner_of(self, component: Component, found: ComponentClass) -> Spinner:
        """The thread for a component: that of its sensor where it can be connected with others."""
        if not (component.intra_process and issubclass(found, WiredNode)):
            return Spinner(self.context)
        key = component.namespace.strip("/")
        if key not in self._spinners:
            self._spinners[key] = Spinner(self.context)
        return self._spinners[key]

    def _stop(self, loaded: LoadedComponent, timeout: float) -> bool:
        """Destroy a component, and end a thread without any; False where it is still busy."""
        spinner = loaded.spinner
        removed = spinner.do(partial(spinner.remove, loaded))
        is_last = not any(item.spinner is spinner for item in self._components.values())
        if is_last:
            self._spinners = {k: item for k, item in self._spinners.items() if item is not spinner}
            spinner.end()
        try:
            removed.result(timeout)
        except LateError:
            return False
        if is_last:
            # Its frames would keep the node from being freed.
            spinner.join(timeout)
        _free_memory()
        return True

    def _check_open(self) -> None:
        if self._closed:
            msg = "the container is shutting down"
            raise ComponentLoadError(msg)

    def _check_name(self, name: str) -> None:
        for unique_id, other in self._components.items():
            if other.full_name == name:
                msg = f"found the name {name}, which id {unique_id} has already"
                raise ComponentLoadError(f"{msg}; expected a different name")


def _free_memory() -> None:
    """Free what is unloaded; all components wait for that 0.1 s.

    A node and its callbacks refer to one another; its arrays, some 30 MB of a sensor, would
    stay until Python looks for such circles by itself.
    """
    gc.unfreeze()
    gc.collect()
    spare_the_collector()
