"""One component: built, spun and destroyed on a thread of its own.

The node and its executor are made, spun and destroyed on that one thread: a node that is destroyed
under an executor of another thread crashes the process.  What is handed over within the process
comes on a second thread, because a wait set is built again for each message that an executor waits
for, which costs more than passing it on itself.  Callbacks never run at the same time.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any

from rclpy.context import Context
from rclpy.executors import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
)
from rclpy.logging import get_logger
from rclpy.node import Node

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.intra_process import Member
from cmp_tactile_processing.ros.intra_process_node import joining

__all__ = ["ComponentClass", "ComponentThread"]

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
        self._executor: SingleThreadedExecutor | None = None
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
        except (ExternalShutdownException, ShutdownException):
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
        executor = SingleThreadedExecutor(context=self._context)
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
            except ConditionReachedException:
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
