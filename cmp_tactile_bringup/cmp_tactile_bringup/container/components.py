"""The component container: loads, unloads and lists components in this process.

One thread spins all nodes of a sensor, and another one any other node: what that does, however
long, holds up no sensor.  A node is destroyed on the thread that spins it: under an executor of
another thread that crashes the process.  Frames pass through a sensor's nodes on a thread of their
own (`ros/wiring.py`), because an executor builds its wait set again for each event.
"""

from __future__ import annotations

import ctypes
import gc
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from dataclasses import dataclass
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

from cmp_tactile_bringup.errors import ComponentError, ComponentLoadError, UnknownComponentError
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.wiring import WiredNode, Wiring, joining

ComponentClass = type[Node]
"""Built as cls(cli_args=..., use_global_arguments=False, parameter_overrides=...)."""


class LoadedComponent:
    """The life of one component, built on a thread that ends then.

    `ready` gives the full node name once the component runs; it raises ComponentLoadError where
    the constructor failed or the component was stopped before it was built.
    """

    def __init__(
        self,
        make: Callable[[], ComponentClass],
        arguments: dict[str, Any],
        spinner_of: Callable[[ComponentClass], Spinner],
    ) -> None:
        """make: looks the class up (its import can be slow, so it runs on the thread too).

        spinner_of: which thread runs components of a class.
        """
        self.ready: Future[str] = Future()
        self.node: Node | None = None
        self.callback_errors = 0
        self.last_error = ""
        self.ending = ""
        self._make, self._arguments, self._spinner_of = make, arguments, spinner_of
        self._lock = threading.Lock()
        self._spinner: Spinner | None = None
        self._is_stopped = False
        self._gone = threading.Event()

    @property
    def failure(self) -> str:
        """Why the component runs no more, or what its attribute `failure` says; empty where none.

        The one thing of a component that is asked for on other threads.
        """
        try:
            return self.ending or str(getattr(self.node, "failure", ""))
        except Exception as error:  # noqa: BLE001  whoever asks must not pay for it
            return f"cannot tell whether it failed: {type(error).__name__}: {error}"

    def start(self) -> None:
        """Begin to build the component."""
        threading.Thread(target=self._run, name="constructor", daemon=True).start()

    def request_stop(self) -> None:
        """End after the running callback; returns at once."""
        with self._lock:
            spinner = None if self._is_stopped else self._spinner
            self._is_stopped = True
        if spinner is not None:
            spinner.do(partial(spinner.remove, self))
        self.fail("the container is shutting down")

    def join(self, timeout: float) -> bool:
        """Wait for the component to be destroyed; False where it takes longer, in s."""
        return self._gone.wait(timeout)

    def fail(self, reason: str) -> None:
        """Answer whoever waits for it to be ready."""
        with suppress(Exception):  # whoever waits has the answer already
            self.ready.set_exception(ComponentLoadError(reason))

    def begins(self, node: Node) -> None:
        """It is spun from now on."""
        _warn_of_unknown_parameters(node, self._arguments)
        with suppress(Exception):  # stopped meanwhile
            self.ready.set_result(node.get_fully_qualified_name())

    def end(self, release: Callable[[], None] = lambda: None) -> None:
        """Destroy the node, on the thread that spins it; release: called before others know."""
        node, self.node = self.node, None
        if node is not None:
            _destroy(node)
        # Else whoever loads it waits without end, where it ended before it ran.
        self.fail(self.ending or "the ROS context has ended")
        release()
        self._gone.set()

    def report(self, error: BaseException) -> None:
        """Log the traceback; the same one again and again only once in five seconds."""
        if self.node is None:
            return
        text = "".join(traceback.format_exception(error))
        self.callback_errors += 1
        is_known, self.last_traceback = text == self.last_traceback, text
        self.last_error = text.strip().rpartition("\n")[2]
        message = f"a callback raised (number {self.callback_errors}); the node goes on\n{text}"
        if is_known:
            self.node.get_logger().error(message, throttle_duration_sec=5.0)
        else:
            self.node.get_logger().error(message)

    last_traceback = ""

    def _run(self) -> None:
        spinner = None
        try:
            found = self._make()
            spinner = self._spinner_of(found)
            with joining(spinner.wiring):
                self.node = _build(found, self._arguments)
        except CmpTactileError as error:
            self.fail(str(error))
        except BaseException as error:  # noqa: BLE001  sys.exit must not end the container
            get_logger("component_container").error(traceback.format_exc())
            self.fail(f"{type(error).__name__}: {error}")
        with self._lock:
            runs = self.node is not None and not self._is_stopped
            self._spinner = spinner if runs else None
        if spinner is not None:
            spinner.do(partial(spinner.add if runs else spinner.remove, self))
        else:
            self.end()


class Spinner:
    """A thread that spins and destroys nodes: those of one sensor together, any other by itself.

    Callbacks of its nodes never run at the same time, nor while the wiring passes a frame on.
    `users` counts components that are built for it, or run; without any it ends.
    """

    def __init__(self, context: Context, release: Callable[[Spinner], None]) -> None:
        """release: called when a component is gone."""
        self.wiring = Wiring()
        self.users = 0
        self._context, self._release = context, release
        self._lock = threading.Lock()
        self._components: list[LoadedComponent] = []
        self._jobs: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._executor = executors.SingleThreadedExecutor(context=context)
        self._ends = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name="component", daemon=True)
        self._thread.start()

    def do(self, job: Callable[[], None]) -> None:
        """Do something on this thread, between two callbacks; at once where it has ended."""
        with self._lock:
            if not self._has_ended:
                self._jobs.put(job)
                self._executor.wake()
                return
        job()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end; False where that takes longer, in s."""
        if self._thread is not threading.current_thread():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def add(self, component: LoadedComponent) -> None:
        """Spin a component that is built; a job."""
        node = component.node
        if node is None or self._ends:
            self.remove(component)
            return
        self._components.append(component)
        self._executor.add_node(node)
        if isinstance(node, WiredNode):
            node.attach()
        component.begins(node)

    def remove(self, component: LoadedComponent) -> None:
        """Destroy a component; a job."""
        if component in self._components:
            self._components.remove(component)
        if component.node is not None:
            if isinstance(component.node, WiredNode):
                component.node.detach()
            self._executor.remove_node(component.node)
        component.end(partial(self._release, self))

    def end(self) -> None:
        """Run no more; a job."""
        self._ends = True

    def _run(self) -> None:
        try:
            while self._context.ok() and not self._ends:
                with suppress(executors.ConditionReachedException):
                    self._spin()
                self._do_jobs()
        except (executors.ExternalShutdownException, executors.ShutdownException):
            pass
        except Exception as error:  # noqa: BLE001  not of a callback, so it cannot go on
            if self._context.ok():
                get_logger("component_container").error(traceback.format_exc())
                for component in self._components:
                    component.ending = f"runs no more: {type(error).__name__}: {error}"
        finally:
            self._ends = True
            self.wiring.close()
            for component in list(self._components):
                self.remove(component)
            with self._lock:
                self._has_ended = True
                self._executor.shutdown()
            self._do_jobs()

    def _do_jobs(self) -> None:
        while not self._jobs.empty():
            job = self._jobs.get()
            with self.wiring.lock:
                job()

    def _spin(self) -> None:
        """Until there is a job, which ConditionReachedException says."""
        while True:
            # The bound method is passed, not a lambda: equal arguments keep the generator.
            task, _, node = self._executor.wait_for_ready_callbacks(None, None, self._has_job)
            with self.wiring.lock:
                error = _error_of(task)
            if error is None:
                error = task.exception()
            else:
                # What is no Exception passes through: the executor would keep the task.
                task.cancel()
            if error is not None:
                for component in self._components:
                    if component.node is node:
                        component.report(error)

    def _has_job(self) -> bool:
        return not self._jobs.empty()


def _error_of(callback: Callable[[], None]) -> BaseException | None:
    try:
        callback()
    except BaseException as error:  # noqa: BLE001  the component goes on, after sys.exit too
        return error
    return None


def _build(component: ComponentClass, arguments: dict[str, Any]) -> Node:
    """Build the component; one whose constructor fails half way leaves no node behind."""
    node: Node = component.__new__(component)  # type: ignore[call-overload]
    try:
        node.__init__(**arguments)
    except BaseException:
        _destroy(node)
        raise
    return node


def _warn_of_unknown_parameters(node: Node, arguments: dict[str, Any]) -> None:
    """Warn of values that no parameter takes: ROS passes over them, also over a mistyped name."""
    given = [item.name for item in arguments.get("parameter_overrides", ())]
    unknown = [name for name in given if not node.has_parameter(name)]
    if unknown:
        text = f"has no parameter {', '.join(unknown)}; the values have no effect"
        node.get_logger().warning(text)


def _destroy(node: Node) -> None:
    try:
        node.destroy_node()
    except Exception:  # noqa: BLE001
        # The override of a half-built component may miss what it wants to close.
        with suppress(Exception):
            Node.destroy_node(node)


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
    """Runs components, those of a sensor connected with one another and on one thread.

    All methods may be called from any thread.  The ROS context must be valid until `shutdown`
    returned; the container does not end it.
    """

    def __init__(
        self, context: Context | None = None, lookup: ComponentLookup = find_component
    ) -> None:
        self._context = get_default_context() if context is None else context
        self._lookup = lookup
        self._spinners: dict[str, Spinner] = {}
        self._ending: list[Spinner] = []
        self._threads_before = frozenset(threading.enumerate())
        self._lock = threading.Lock()
        self._next_id = 1
        self._components: dict[int, LoadedComponent] = {}
        self._names: dict[int, str] = {}
        self._closed = False
        self._collector: threading.Timer | None = None
        self._left_behind: tuple[tuple[str, LoadedComponent], ...] = ()
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
        return tuple(name for name, life in self._left_behind if not life.join(0))

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
        life = LoadedComponent(lookup, arguments, partial(self._spinner_of, component))
        unique_id = self._register(life)
        try:
            name = life.ready.result(timeout)
        except FutureTimeoutError:
            self._forget(unique_id)
            self._end(label, life, 0)
            msg = f"{label}: the constructor took more than {timeout} s"
            raise ComponentLoadError(msg) from None
        except ComponentLoadError as error:
            self._forget(unique_id)
            raise ComponentLoadError(f"{label}: {error}") from None
        try:
            self._take_name(unique_id, name)
        except ComponentLoadError as error:
            self._forget(unique_id)
            self._end(label, life, STOP_TIMEOUT)
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
            life = self._components.pop(unique_id) if name is not None else None
        if life is None:
            known = ", ".join(str(item.unique_id) for item in self.list()) or "none"
            msg = f"no component has the id {unique_id}; loaded ids: {known}"
            raise UnknownComponentError(msg)
        if not self._end(str(name), life, timeout):
            msg = f"{name}: a callback still runs after {timeout} s"
            raise ComponentError(msg)
        self._collect_later()

    def list(self) -> tuple[ComponentStatus, ...]:
        """The running components, in the order in which they were loaded."""
        with self._lock:
            return tuple(
                ComponentStatus(key, name, life.callback_errors, life.last_error, life.failure)
                for key, name in sorted(self._names.items())
                for life in [self._components[key]]
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
            lives, self._components = dict(self._components), {}
            names, self._names = dict(self._names), {}
        if collector is not None:
            collector.cancel()
        for life in lives.values():
            life.request_stop()
        deadline = time.monotonic() + timeout
        late = [
            name
            for key, life in lives.items()
            for name in [names.get(key, "a component that is being built")]
            if not self._end(name, life, max(0.0, deadline - time.monotonic()))
        ]
        for spinner in self._ending:
            # Else it would end beside the ROS context.
            spinner.join(max(0.0, deadline - time.monotonic()))
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

    def _end(self, name: str, life: LoadedComponent, timeout: float) -> bool:
        """Stop a component and wait for that; False where it takes longer, in s."""
        life.request_stop()
        if life.join(timeout):
            return True
        with self._lock:
            others = (item for item in self._left_behind if not item[1].join(0))
            self._left_behind = (*others, (name, life))
        return False

    def _spinner_of(self, component: Component, found: ComponentClass) -> Spinner:
        """The thread for a component: that of its sensor where it can be connected with others."""
        key = f"/{component.namespace.strip('/')}"
        shared = component.intra_process and issubclass(found, WiredNode)
        with self._lock:
            spinner = self._spinners.get(key) if shared else None
            if spinner is None:
                spinner = Spinner(self._context, self._release)
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

    def _register(self, life: LoadedComponent) -> int:
        with self._lock:
            if self._closed:
                msg = "the container is shutting down"
                raise ComponentLoadError(msg)
            unique_id = self._next_id
            self._next_id += 1
            self._components[unique_id] = life
            # In here, as `shutdown` joins whatever is registered.
            life.start()
        return unique_id

    def _take_name(self, unique_id: int, name: str) -> None:
        """Keep the name, unless another component has it: ROS would let them share it."""
        with self._lock:
            if unique_id not in self._components:
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
            self._components.pop(unique_id, None)
