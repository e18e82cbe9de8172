"""The component container: loads, unloads and lists components in this process."""

from __future__ import annotations

import ctypes
import gc
import threading
import time
from collections.abc import Callable
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
from typing import Any

from rclpy.context import Context
from rclpy.logging import LoggingSeverity, get_logger, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from cmp_tactile_bringup.container.component_thread import ComponentClass, ComponentThread
from cmp_tactile_bringup.errors import ComponentError, ComponentLoadError, UnknownComponentError
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.intra_process import Exchange, Member

__all__ = [
    "ENTRY_POINT_GROUP",
    "ComponentContainer",
    "ComponentStatus",
    "find_component",
    "node_arguments",
    "ros_parameters",
]

ENTRY_POINT_GROUP = "cmp_tactile_components"

ComponentLookup = Callable[[str, str], ComponentClass]
"""From package and plugin name to the class; raises ComponentLoadError where there is none."""

STOP_TIMEOUT = 4.0
"""How long a running callback may take to end, s; launch kills a process after 5 s."""

COLLECT_AFTER = 0.5
"""How long after an unloading its memory is given back, s; all components wait for that 0.1 s."""


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


def ros_parameters(component: Component) -> list[Parameter[Any]]:
    """The parameters of a component as rclpy has them."""
    return [
        value if isinstance(value, Parameter) else Parameter(name, value=value)
        for name, value in component.parameters.items()
    ]


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
    remappings = [word for rule in rules for word in ("-r", rule)]
    return {
        "cli_args": ["--ros-args", *remappings] if rules else [],
        "use_global_arguments": False,
        "parameter_overrides": ros_parameters(component),
    }


@dataclass(frozen=True)
class ComponentStatus:
    """A loaded component: its id, full node name, and how many of its callbacks raised.

    failure: why it can do its work no longer, as its attribute `failure` says; empty where it can
    or has no such attribute.
    """

    unique_id: int
    full_name: str
    callback_errors: int
    last_error: str
    failure: str = ""


class ComponentContainer:
    """Runs components, each on a thread of its own, and hands messages over between them.

    All methods may be called from any thread.  The ROS context must be valid until `shutdown`
    returned; the container does not end it.
    """

    def __init__(
        self, context: Context | None = None, lookup: ComponentLookup = find_component
    ) -> None:
        self._context = get_default_context() if context is None else context
        self._lookup = lookup
        self._exchange = Exchange()
        self._threads_before = frozenset(threading.enumerate())
        self._lock = threading.Lock()
        self._next_id = 1
        self._threads: dict[int, ComponentThread] = {}
        self._names: dict[int, str] = {}
        self._closed = False
        self._collector: threading.Timer | None = None
        self._left_behind: tuple[tuple[str, ComponentThread], ...] = ()
        self.process_of: Callable[[str, Callable[[], bool]], str] = lambda _name, _stopped: ""
        """Where else a node of a full name runs, as NamesInUse says it; asked before each load."""

    @property
    def context(self) -> Context:
        """The ROS context of all components."""
        return self._context

    @property
    def has_threads(self) -> bool:
        """Whether a thread runs that was not there before the container, of whoever."""
        return bool(frozenset(threading.enumerate()) - self._threads_before)

    @property
    def left_behind(self) -> tuple[str, ...]:
        """What still runs of what `load`, `unload` and `shutdown` gave up waiting for."""
        return tuple(name for name, thread in self._left_behind if not thread.join(0))

    def load(self, component: Component, timeout: float | None = None) -> int:
        """Build a component and run it; returns its id once it runs.

        Other calls are served meanwhile, however long the constructor takes.
        Raises ComponentLoadError with the reason; also after `timeout` s, and where another
        component has the same full name.
        """
        component.check()
        label = component.label
        arguments = node_arguments(component)
        if self._context is not get_default_context():
            arguments["context"] = self._context
        lookup = partial(self._find, component)
        member = Member(self._exchange) if component.intra_process else None
        thread = ComponentThread(lookup, arguments, self._context, member)
        unique_id = self._register(thread)
        try:
            name = thread.ready.result(timeout)
        except FutureTimeoutError:
            self._forget(unique_id)
            self._end(label, thread, 0)
            msg = f"{label}: the constructor took more than {timeout} s"
            raise ComponentLoadError(msg) from None
        except ComponentLoadError as error:
            self._forget(unique_id)
            raise ComponentLoadError(f"{label}: {error}") from None
        try:
            self._take_name(unique_id, name)
        except ComponentLoadError as error:
            self._forget(unique_id)
            self._end(label, thread, STOP_TIMEOUT)
            raise ComponentLoadError(f"{label}: {error}") from None
        if component.log_level:
            logger_name = name.strip("/").replace("/", ".")
            set_logger_level(logger_name, LoggingSeverity(component.log_level))
        return unique_id

    def unload(self, unique_id: int, timeout: float = STOP_TIMEOUT) -> None:
        """Stop and destroy a component.

        Raises UnknownComponentError, or ComponentError where its running callback does not end
        within `timeout` s; the component is then gone as soon as that callback ends.
        """
        with self._lock:
            name = self._names.pop(unique_id, None)
            thread = self._threads.pop(unique_id) if name is not None else None
        if thread is None:
            known = ", ".join(str(item.unique_id) for item in self.list()) or "none"
            msg = f"no component has the id {unique_id}; loaded ids: {known}"
            raise UnknownComponentError(msg)
        if not self._end(str(name), thread, timeout):
            msg = f"{name}: a callback still runs after {timeout} s"
            raise ComponentError(msg)
        self._collect_later()

    def list(self) -> tuple[ComponentStatus, ...]:
        """The running components, in the order in which they were loaded."""
        with self._lock:
            return tuple(
                ComponentStatus(
                    key, name, thread.callback_errors, thread.last_error, thread.failure
                )
                for key, name in sorted(self._names.items())
                for thread in [self._threads[key]]
            )

    def full_name(self, unique_id: int) -> str:
        """The full node name of a loaded component; UnknownComponentError where there is none."""
        for item in self.list():
            if item.unique_id == unique_id:
                return item.full_name
        msg = f"no component has the id {unique_id}"
        raise UnknownComponentError(msg)

    def shutdown(self, timeout: float = STOP_TIMEOUT) -> bool:
        """Stop and destroy all components; no more can be loaded.

        Returns False where a callback or a constructor still ran after `timeout` s.
        """
        with self._lock:
            self._closed = True
            collector = self._collector
            threads, self._threads = dict(self._threads), {}
            names, self._names = dict(self._names), {}
        if collector is not None:
            collector.cancel()
        for thread in threads.values():
            thread.request_stop()
        deadline = time.monotonic() + timeout
        late = [
            name
            for key, thread in threads.items()
            for name in [names.get(key, "a component that is being built")]
            if not self._end(name, thread, max(0.0, deadline - time.monotonic()))
        ]
        if late:
            message = f"still busy after {timeout} s and left behind: {', '.join(late)}"
            get_logger("component_container").warning(message)
        return not late

    def _find(self, component: Component) -> ComponentClass:
        """The class of a component, unless another process has one of that name.

        Looked up first: meanwhile the nodes of other processes become known.
        """
        found = self._lookup(component.package, component.plugin)
        name = component.full_name
        with self._lock:
            own = name in self._names.values()
        if name and not own and (process := self.process_of(name, lambda: self._closed)):
            msg = (
                f"{name} runs already, in process {process}: end that, or give this sensor another "
                "namespace (namespace:=NAME)"
            )
            raise ComponentLoadError(msg)
        if self._closed:
            # Stopped while it waited: what would be built now would hold up the end.
            msg = "the container is shutting down"
            raise ComponentLoadError(msg)
        return found

    def _end(self, name: str, thread: ComponentThread, timeout: float) -> bool:
        """Stop a component and wait for that; False where it takes longer, in s."""
        thread.request_stop()
        if thread.join(timeout):
            return True
        with self._lock:
            others = (item for item in self._left_behind if not item[1].join(0))
            self._left_behind = (*others, (name, thread))
        return False

    def _register(self, thread: ComponentThread) -> int:
        with self._lock:
            if self._closed:
                msg = "the container is shutting down"
                raise ComponentLoadError(msg)
            unique_id = self._next_id
            self._next_id += 1
            self._threads[unique_id] = thread
            # In here, as `shutdown` joins whatever is registered.
            thread.start()
        return unique_id

    def _take_name(self, unique_id: int, name: str) -> None:
        """Keep the name, unless another component has it: ROS would let them share it."""
        with self._lock:
            if unique_id not in self._threads:
                msg = "the container is shutting down"
                raise ComponentLoadError(msg)
            for other, taken in self._names.items():
                if taken == name:
                    msg = f"id {unique_id}: the name {name} is that of id {other} already"
                    raise ComponentLoadError(msg)
            self._names[unique_id] = name

    def _collect_later(self) -> None:
        """Give back the memory of what is unloaded, once for all that is unloaded together.

        A node and its callbacks refer to one another; its arrays, some 30 MB of a sensor, would
        stay until Python looks for such circles by itself.
        """
        with self._lock:
            if self._collector is None and not self._closed:
                self._collector = threading.Timer(COLLECT_AFTER, self._collect)
                self._collector.daemon = True
                self._collector.start()

    def _collect(self) -> None:
        with self._lock:
            self._collector = None
        gc.collect()
        # glibc keeps what is freed in an arena for each of many threads, 100 MB and more.
        with suppress(AttributeError, OSError):
            ctypes.CDLL(None).malloc_trim(0)

    def _forget(self, unique_id: int) -> None:
        with self._lock:
            self._threads.pop(unique_id, None)
