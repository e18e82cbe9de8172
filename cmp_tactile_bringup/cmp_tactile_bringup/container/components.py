"""The component container: loads, unloads and lists components in this process."""

from __future__ import annotations

import gc
import itertools
import threading
import time
from collections.abc import Callable
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


ENDING = "the container is shutting down"


class ComponentContainer:
    """Runs components, those of a sensor connected with one another and on one thread.

    All methods may be called from any thread.  The ROS context must be valid until `shutdown`
    returned; the container does not end it.
    context: that of all components.  threads_before: those that ran before the container.
    """

    def __init__(
        self, context: Context | None = None, lookup: ComponentLookup = find_component
    ) -> None:
        self.context = get_default_context() if context is None else context
        self._lookup = lookup
        self._spinners: dict[str, Spinner] = {}
        self._ending: list[Spinner] = []
        self.threads_before = frozenset(threading.enumerate())
        self._lock = threading.Lock()
        self._ids = itertools.count(1)
        # Those that are being built, too, which have no name yet.
        self._components: dict[int, LoadedComponent] = {}
        self._closed = False

    def load(self, component: Component) -> int:
        """Build a component and run it; returns its id once it runs.

        Other calls are served meanwhile, however long the constructor takes.
        Raises ComponentLoadError with the reason, also where another component has the name.
        """
        component.check()
        arguments = node_arguments(component)
        if self.context is not get_default_context():
            arguments["context"] = self.context
        life = self._register()
        try:
            found = self._find(component)
            spinner = self._spinner_of(component, found)
            self._take_name(life, life.build(found, arguments, spinner))
            life.run(spinner)
        except ComponentLoadError as error:
            with self._lock:
                self._components.pop(life.unique_id, None)
            life.request_stop()
            life.join(0.0 if self._closed else STOP_TIMEOUT)
            _free_memory()
            raise ComponentLoadError(f"{component.label}: {error}") from None
        if component.log_level:
            logger_name = life.full_name.strip("/").replace("/", ".")
            set_logger_level(logger_name, LoggingSeverity(component.log_level))
        spare_the_collector()
        return life.unique_id

    def unload(self, unique_id: int, timeout: float = STOP_TIMEOUT) -> None:
        """Stop and destroy a component.

        Raises ComponentError for an unknown id, and where its running callback does not end
        within `timeout` s; the component is then gone as soon as that callback ends.
        """
        with self._lock:
            life = self._components.get(unique_id)
            if life is not None and life.full_name:
                del self._components[unique_id]
        if life is None or not life.full_name:
            known = ", ".join(str(item.unique_id) for item in self.list()) or "none"
            msg = f"no component has the id {unique_id}; loaded ids: {known}"
            raise ComponentError(msg)
        life.request_stop()
        if not life.join(timeout):
            msg = f"{life.full_name}: found a callback that still runs after {timeout} s"
            raise ComponentError(msg)
        _free_memory()

    def list(self) -> tuple[LoadedComponent, ...]:
        """The running components, in the order in which they were loaded."""
        with self._lock:
            return tuple(life for life in self._components.values() if life.full_name)

    def shutdown(self, timeout: float = STOP_TIMEOUT) -> None:
        """Stop and destroy all components; no more can be loaded.

        A callback or a constructor that still runs after `timeout` s is left behind, with a
        warning.
        """
        with self._lock:
            self._closed = True
            lives, self._components = self._components, {}
        for life in lives.values():
            # What is being built is stopped by `load`.
            if life.full_name:
                life.request_stop()
        deadline = time.monotonic() + timeout
        late = [
            life.full_name or "a component that is being built"
            for life in lives.values()
            if not life.join(max(0.0, deadline - time.monotonic()))
        ]
        for spinner in self._ending:
            # Else it would end beside the ROS context.
            spinner.join(max(0.0, deadline - time.monotonic()))
        if late:
            message = f"still busy after {timeout} s; not waited for any longer: {', '.join(late)}"
            get_logger("component_container").warning(message)

    def _find(self, component: Component) -> ComponentClass:
        """The class of a component."""
        found = self._lookup(component.package, component.plugin)
        if self._closed:
            # Stopped meanwhile: what would be built now would hold up the end.
            raise ComponentLoadError(ENDING)
        return found

    def _spinner_of(self, component: Component, found: ComponentClass) -> Spinner:
        """The thread for a component: that of its sensor where it can be connected with others."""
        key = f"/{component.namespace.strip('/')}"
        shared = component.intra_process and issubclass(found, WiredNode)
        with self._lock:
            spinner = self._spinners.get(key) if shared else None
            if spinner is None:
                spinner = Spinner(self.context, self._release)
            if shared:
                self._spinners[key] = spinner
            spinner.users += 1
            return spinner

    def _release(self, spinner: Spinner) -> None:
        """A component of a thread is gone; without any the thread ends."""
        with self._lock:
            spinner.users -= 1
            if spinner.users:
                return
            kept = {key: item for key, item in self._spinners.items() if item is not spinner}
            self._spinners = kept
            self._ending = [item for item in self._ending if not item.join(0)] + [spinner]
        spinner.do(spinner.end)

    def _register(self) -> LoadedComponent:
        life = LoadedComponent()
        with self._lock:
            if self._closed:
                raise ComponentLoadError(ENDING)
            life.unique_id = next(self._ids)
            self._components[life.unique_id] = life
        return life

    def _take_name(self, life: LoadedComponent, name: str) -> None:
        """Keep the name, unless another component has it: ROS would let them share it."""
        with self._lock:
            if life.unique_id not in self._components:
                raise ComponentLoadError(ENDING)
            for other in self._components.values():
                if other.full_name == name:
                    msg = (
                        f"id {life.unique_id}: found the name {name}, which id {other.unique_id} "
                        "has already; expected a different name"
                    )
                    raise ComponentLoadError(msg)
            life.full_name = name


def _free_memory() -> None:
    """Free what is unloaded; all components wait for that 0.1 s.

    A node and its callbacks refer to one another; its arrays, some 30 MB of a sensor, would
    stay until Python looks for such circles by itself.
    """
    gc.unfreeze()
    gc.collect()
    spare_the_collector()
