"""The component container: loads, unloads and lists components in this process.

The node and its executor of a component are made, spun and destroyed on a thread of its own: a node
that is destroyed under an executor of another thread crashes the process.  What is handed over
within the process comes on a second thread, because a wait set is built again for each message that
an executor waits for, which costs more than passing it on itself.  Callbacks never run at the same
time.
"""

from __future__ import annotations

import ctypes
import gc
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib.metadata import entry_points
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
from cmp_tactile_processing.ros.intra_process import Exchange, Member, joining

ComponentClass = type[Node]
"""Built as cls(cli_args=..., use_global_arguments=False, parameter_overrides=...)."""


class FairLock:
    """A lock for which a thread that waits comes before one that has just released it.

    Python's own may be taken again and again by one busy thread, while the other starves.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._held = threading.Lock()

    def __enter__(self) -> None:
        with self._turn:
            self._held.acquire()

    def __exit__(self, *_: object) -> None:
        self._held.release()


class ComponentThread:
    """The life of one component.

    `ready` gives the full node name once the component runs; it raises ComponentLoadError where
    the constructor failed or the component was stopped before it was built.
    """

    def __init__(
        self,
        make: Callable[[], ComponentClass],
        arguments: dict[str, Any],
        context: Context,
        member: Member | None = None,
    ) -> None:
        """make: looks the class up (its import can be slow, so it runs on the thread too).

        member: its part in the exchange of the container; None where all goes over DDS.
        """
        self.ready: Future[str] = Future()
        self._make = make
        self._arguments = arguments
        self._context = context
        self._member = member
        self._callbacks = FairLock()
        # Callbacks raise on two threads.
        self._counting = threading.Lock()
        self._stopping = threading.Event()
        self._executor: executors.SingleThreadedExecutor | None = None
        self._node: Node | None = None
        self._callback_errors = 0
        self._last_error = ""
        self._failure = ""
        self._thread = threading.Thread(target=self._run, name="component", daemon=True)

    @property
    def callback_errors(self) -> int:
        """How many callbacks raised so far."""
        return self._callback_errors

    @property
    def last_error(self) -> str:
        """The last line of the last callback error; empty where there was none."""
        return self._last_error.strip().rpartition("\n")[2]

    @property
    def failure(self) -> str:
        """Why the component runs no more, or what its attribute `failure` says; empty where none.

        The one thing of a component that is asked for on other threads.
        """
        try:
            return self._failure or str(getattr(self._node, "failure", ""))
        except Exception as error:  # noqa: BLE001  whoever asks must not pay for it
            return f"cannot tell whether it failed: {type(error).__name__}: {error}"

    def start(self) -> None:
        """Begin to build the component."""
        self._thread.start()

    def request_stop(self) -> None:
        """End after the running callback; returns at once."""
        self._stopping.set()
        executor = self._executor
        if executor is not None:
            with suppress(Exception):  # it ends at this moment, by itself
                executor.wake()
        self._fail("the container is shutting down")

    def join(self, timeout: float) -> bool:
        """Wait for the component to be destroyed; False where it takes longer, in s."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            with joining(self._member):
                node = _build(self._make(), self._arguments)
        except CmpTactileError as error:
            self._fail(str(error))
            return
        except BaseException as error:  # noqa: BLE001  sys.exit must not end the container
            get_logger("component_container").error(traceback.format_exc())
            self._fail(f"{type(error).__name__}: {error}")
            return
        self._node = node
        try:
            self._spin(node)
        except (executors.ExternalShutdownException, executors.ShutdownException):
            pass
        except Exception as error:  # noqa: BLE001  not of a callback, so it cannot go on
            if self._context.ok():
                get_logger("component_container").error(traceback.format_exc())
                self._failure = f"runs no more: {type(error).__name__}: {error}"
        finally:
            self._node = None
            _destroy(node)
            # Else whoever loads it waits without end, where it ended before it ran.
            self._fail(self._failure or "the ROS context has ended")

    def _fail(self, reason: str) -> None:
        with suppress(Exception):  # whoever waits has the answer already
            self.ready.set_exception(ComponentLoadError(reason))

    def _spin(self, node: Node) -> None:
        executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor = executor
        executor.add_node(node)
        _warn_of_unknown_parameters(node, self._arguments)
        with suppress(Exception):  # stopped meanwhile
            self.ready.set_result(node.get_fully_qualified_name())
        with self._receiving(node):
            try:
                while self._context.ok():
                    # The bound method is passed, not a lambda: equal arguments keep the generator.
                    stopped = self._stopping.is_set
                    task, _, _ = executor.wait_for_ready_callbacks(None, None, stopped)
                    with self._callbacks:
                        error = _error_of(task)
                    if error is None:
                        error = task.exception()
                    else:
                        # What is no Exception passes through: the executor would keep the task.
                        task.cancel()
                    if error is not None:
                        self._report(node, error)
            except executors.ConditionReachedException:
                pass
            finally:
                self._executor = None
                executor.shutdown()

    @contextmanager
    def _receiving(self, node: Node) -> Iterator[None]:
        """Deliver what is handed over to the node in here; at the end the last callback is over."""
        member = self._member
        if member is None:
            yield
            return
        receiver = threading.Thread(
            target=self._receive, args=(node, member), name="intra-process", daemon=True
        )
        receiver.start()
        try:
            yield
        finally:
            member.stop()
            receiver.join()

    def _receive(self, node: Node, member: Member) -> None:
        while (inbox := member.next()) is not None:
            with self._callbacks:
                if self._stopping.is_set():
                    return
                error = _error_of(inbox.deliver)
            if error is not None and self._context.ok():
                self._report(node, error)

    def _report(self, node: Node, error: BaseException) -> None:
        """Log the traceback; the same one again and again only once in five seconds."""
        text = "".join(traceback.format_exception(error))
        with self._counting:
            self._callback_errors += 1
            number, is_known = self._callback_errors, text == self._last_error
            self._last_error = text
        message = f"a callback raised (number {number}); the node goes on\n{text}"
        if is_known:
            node.get_logger().error(message, throttle_duration_sec=5.0)
        else:
            node.get_logger().error(message)


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
