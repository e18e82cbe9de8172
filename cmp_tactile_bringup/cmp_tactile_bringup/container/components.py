"""The component container: loads, unloads and lists components in this process.

A thread spins the components of one sensor together, or any other one by itself.  A node is
destroyed on the thread that spins it: under an executor of another thread that crashes the process.
Frames pass through a sensor's nodes on a thread of their own (`ros/wiring.py`), because an executor
builds its wait set again for each event.
"""

from __future__ import annotations

import gc
import threading
import time
import traceback
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as LateError
from contextlib import suppress
from functools import partial
from importlib.metadata import entry_points
from queue import SimpleQueue
from typing import Any

from rclpy import executors
from rclpy.context import Context
from rclpy.logging import LoggingSeverity, get_logger, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import get_default_context

from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.process import CallbackErrors, spare_the_collector
from cmp_tactile_processing.ros.shared_clock import SharedClock
from cmp_tactile_processing.ros.wiring import WiredNode, Wiring, joining

ENTRY_POINT_GROUP = "cmp_tactile_components"

ComponentClass = type[Node]
"""Built as cls(cli_args=..., use_global_arguments=False, parameter_overrides=...)."""

ComponentLookup = Callable[[str, str], ComponentClass]
"""From package and plugin name to the class; raises CmpTactileError where there is none."""

STOP_TIMEOUT = 4.0
"""How long a running callback may take to end, s; launch kills a process after 5 s."""
# How often, and how long apart in s, it is tried to free an unloaded component.
FREEING_TRIES, FREEING_S = 5, 0.05


def find_component(package: str, plugin: str) -> ComponentClass:
    """The class that `package` registers as `plugin` in the group cmp_tactile_components.

    Raises CmpTactileError, which lists the known plugins, or names why the import failed.
    """
    if plugin.partition("::")[0] != package:
        msg = f"found package {package!r}, expected the package in the plugin's name {plugin!r}"
        raise CmpTactileError(msg)
    known = entry_points(group=ENTRY_POINT_GROUP)
    matches = [point for point in known if point.name == plugin]
    if not matches:
        names = ", ".join(sorted({point.name for point in known})) or "none"
        msg = f"found no installed component {plugin!r}, expected one of: {names}"
        raise CmpTactileError(msg)
    try:
        found: Any = matches[0].load()
    except (Exception, SystemExit) as error:
        msg = f"{matches[0].value} cannot be imported: {type(error).__name__}: {error}"
        raise CmpTactileError(msg) from error
    if not (isinstance(found, type) and issubclass(found, Node)):
        msg = f"{matches[0].value} is {found!r}, expected a class derived from rclpy's Node"
        raise CmpTactileError(msg)
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
    context: that of all components.
    """

    def __init__(
        self, context: Context | None = None, lookup: ComponentLookup = find_component
    ) -> None:
        self.context = get_default_context() if context is None else context
        self._lookup = lookup
        self._clock = SharedClock(self.context)
        self._lock = threading.Lock()
        self._components: dict[int, LoadedComponent] = {}
        self._spinners: dict[str, Spinner] = {}
        self._last_id = 0
        self._closed = False

    def load(self, component: Component) -> int:
        """Build a component and run it; returns its id once it runs.

        Raises CmpTactileError with the reason, also where another component has the name.
        """
        with self._lock:
            try:
                return self._load(component)
            except CmpTactileError as error:
                raise CmpTactileError(f"{component.label}: {error}") from None

    def _load(self, component: Component) -> int:
        try:
            log_level = LoggingSeverity(component.log_level)
        except ValueError as error:
            msg = f"log level: {error}"
            raise CmpTactileError(msg) from None
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
        except CmpTactileError:
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

        Raises CmpTactileError for an unknown id, and where its running callback does not end
        within `timeout` s; the component is then gone as soon as that callback ends.
        """
        with self._lock:
            loaded = self._components.pop(unique_id, None)
            if loaded is None:
                known = ", ".join(map(str, self._components)) or "none"
                msg = f"no component has the id {unique_id}; loaded ids: {known}"
                raise CmpTactileError(msg)
            if not self._stop(loaded, timeout):
                msg = f"{loaded.full_name}: found a callback that still runs after {timeout} s"
                raise CmpTactileError(msg)

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
        self._clock.close()
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
            return Spinner(self.context, self._clock)
        key = component.namespace.strip("/")
        if key not in self._spinners:
            self._spinners[key] = Spinner(self.context, self._clock)
        return self._spinners[key]

    def _stop(self, loaded: LoadedComponent, timeout: float) -> bool:
        """Destroy a component, and end a thread without any; False where it is still busy."""
        spinner, node = loaded.spinner, loaded.node
        is_there = weakref.ref(node) if node is not None else lambda: None
        del node
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
        _free_memory(is_there)
        return True

    def _check_open(self) -> None:
        if self._closed:
            msg = "the container is shutting down"
            raise CmpTactileError(msg)

    def _check_name(self, name: str) -> None:
        for unique_id, other in self._components.items():
            if other.full_name == name:
                msg = f"found the name {name}, which id {unique_id} has already"
                raise CmpTactileError(f"{msg}; expected a different name")


def _free_memory(is_there: Callable[[], Node | None]) -> None:
    """Free what is unloaded; all components wait for that 0.1 s.

    A node and its callbacks refer to one another; its arrays, some 30 MB of a sensor, would
    stay until Python looks for such circles by itself.  Another thread may hold it for a moment.
    """
    for _ in range(FREEING_TRIES):
        gc.unfreeze()
        gc.collect()
        if is_there() is None:
            break
        time.sleep(FREEING_S)
    spare_the_collector()


class LoadedComponent:
    """A component and the thread that spins it.

    errors: those of its callbacks.
    """

    def __init__(self, spinner: Spinner) -> None:
        self.spinner = spinner
        self.full_name = ""
        self.node: Node | None = None
        self.errors = CallbackErrors()

    @property
    def failure(self) -> str:
        """Why the component runs no more, or what its attribute `failure` says; empty where none.

        The one thing of a component that is asked for on other threads.
        """
        return self.spinner.failure or str(getattr(self.node, "failure", ""))


class Spinner:
    """A thread that spins and destroys nodes: those of one sensor together, any other by itself.

    Callbacks of its nodes never run at the same time, nor while the wiring passes a frame on.
    failure: why it spins no more, where that was an error.
    """

    def __init__(self, context: Context, clock: SharedClock) -> None:
        self.failure = ""
        self._wiring = Wiring(clock)
        self._context = context
        self._lock = threading.Lock()
        self._components: dict[Node, LoadedComponent] = {}
        self._jobs: SimpleQueue[tuple[Callable[[], None], Future[None]]] = SimpleQueue()
        self._executor = executors.SingleThreadedExecutor(context=context)
        self._ends = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name="component", daemon=True)
        self._thread.start()

    def build(
        self, loaded: LoadedComponent, component: ComponentClass, arguments: dict[str, Any]
    ) -> None:
        """Build the node of a component on the thread that calls.

        Raises CmpTactileError where the constructor fails; no node is left behind then.
        """
        node: Node = component.__new__(component)  # type: ignore[call-overload]
        try:
            with joining(self._wiring):
                node.__init__(**arguments)
        except BaseException as error:
            _destroy(node)
            if isinstance(error, CmpTactileError):
                raise
            get_logger("component_container").error(traceback.format_exc())
            # What rclpy says of a wrong name has several lines.
            msg = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise CmpTactileError(msg) from None
        loaded.node, loaded.full_name = node, node.get_fully_qualified_name()

    def do(self, job: Callable[[], None]) -> Future[None]:
        """Do something on this thread, between two callbacks; at once where it has ended.

        The future is done when the job is.
        """
        done: Future[None] = Future()
        with self._lock:
            if not self._has_ended:
                self._jobs.put((job, done))
                self._executor.wake()
                return done
        job()
        done.set_result(None)
        return done

    def end(self) -> None:
        """Destroy all components after the running callback, and run no more; returns at once."""
        self.do(self._end)

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end; False where that takes longer, in s."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def add(self, component: LoadedComponent) -> None:
        """Spin a component that is built; a job."""
        node = component.node
        if node is None or self._ends:
            self.remove(component)
            return
        self._components[node] = component
        self._executor.add_node(node)
        if isinstance(node, WiredNode):
            node.attach()

    def remove(self, component: LoadedComponent) -> None:
        """Destroy a component; a job."""
        node, component.node = component.node, None
        if node is not None:
            self._components.pop(node, None)
            if isinstance(node, WiredNode):
                node.detach()
            self._executor.remove_node(node)
            _destroy(node)

    def _end(self) -> None:
        self._ends = True

    def _run(self) -> None:
        try:
            while self._context.ok() and not self._ends:
                self._spin_once()
        except (executors.ExternalShutdownException, executors.ShutdownException):
            pass
        except Exception as error:  # noqa: BLE001  not of a callback, so it cannot go on
            if self._context.ok():
                get_logger("component_container").error(traceback.format_exc())
                self.failure = f"has stopped: {type(error).__name__}: {error}"
        finally:
            self._ends = True
            self._wiring.close()
            for component in list(self._components.values()):
                self.remove(component)
            with self._lock:
                self._has_ended = True
                self._executor.shutdown()
            self._do_jobs()

    def _do_jobs(self) -> None:
        while not self._jobs.empty():
            job, done = self._jobs.get()
            try:
                with self._wiring.lock:
                    job()
            finally:
                done.set_result(None)

    def _spin_once(self) -> None:
        """Wait for a callback and run it, or for jobs and do them."""
        try:
            # The bound method is passed, not a lambda: equal arguments keep the generator.
            task, _, node = self._executor.wait_for_ready_callbacks(None, None, self._has_job)
        except executors.ConditionReachedException:
            self._do_jobs()
            return
        with self._wiring.lock:
            error = _error_of(task)
        if error is None:
            error = task.exception()
        else:
            # What is no Exception passes through: the executor would keep the task.
            task.cancel()
        if error is not None and node in self._components:
            self._components[node].errors.report(node, error)

    def _has_job(self) -> bool:
        return not self._jobs.empty()


def _error_of(callback: Callable[[], None]) -> BaseException | None:
    try:
        callback()
    except BaseException as error:  # noqa: BLE001  the component goes on, after sys.exit too
        return error
    return None


def _destroy(node: Node) -> None:
    try:
        node.destroy_node()
    except Exception:  # noqa: BLE001
        # The override of a half-built component may miss what it wants to close.
        with suppress(Exception):
            Node.destroy_node(node)
