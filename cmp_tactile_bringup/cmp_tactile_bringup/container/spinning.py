"""Threads that spin components: those of one sensor together, any other one by itself.

A node is destroyed on the thread that spins it: under an executor of another thread that crashes
the process.  Frames pass through a sensor's nodes on a thread of their own (`ros/wiring.py`),
because an executor builds its wait set again for each event.
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Any

from rclpy import executors
from rclpy.context import Context
from rclpy.logging import get_logger
from rclpy.node import Node

from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.process import CallbackErrors
from cmp_tactile_processing.ros.wiring import WiredNode, Wiring, joining

ComponentClass = type[Node]
"""Built as cls(cli_args=..., use_global_arguments=False, parameter_overrides=...)."""


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

    def report(self, error: BaseException) -> None:
        """Log the traceback; the same one again and again only once in five seconds."""
        self.errors.report(self.node, error)


class Spinner:
    """A thread that spins and destroys nodes: those of one sensor together, any other by itself.

    Callbacks of its nodes never run at the same time, nor while the wiring passes a frame on.
    failure: why it spins no more, where that was an error.
    """

    def __init__(self, context: Context) -> None:
        self.failure = ""
        self._wiring = Wiring()
        self._context = context
        self._lock = threading.Lock()
        self._components: list[LoadedComponent] = []
        self._jobs: SimpleQueue[tuple[Callable[[], None], Future[None]]] = SimpleQueue()
        self._executor = executors.SingleThreadedExecutor(context=context)
        self._ends = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name="component", daemon=True)
        self._thread.start()

    def build(
        self, loaded: LoadedComponent, component: ComponentClass, arguments: dict[str, Any]
    ) -> None:
        """Build the node of a component on the thread that calls.

        Raises ComponentLoadError where the constructor fails; no node is left behind then.
        """
        node: Node = component.__new__(component)  # type: ignore[call-overload]
        try:
            with joining(self._wiring):
                node.__init__(**arguments)
        except BaseException as error:  # noqa: BLE001  sys.exit must not end the container
            _destroy(node)
            if isinstance(error, CmpTactileError):
                raise ComponentLoadError(str(error)) from None
            get_logger("component_container").error(traceback.format_exc())
            # What rclpy says of a wrong name has several lines.
            msg = f"{type(error).__name__}: {' '.join(str(error).split())}"
            raise ComponentLoadError(msg) from None
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
        self._components.append(component)
        self._executor.add_node(node)
        if isinstance(node, WiredNode):
            node.attach()

    def remove(self, component: LoadedComponent) -> None:
        """Destroy a component; a job."""
        if component in self._components:
            self._components.remove(component)
        node, component.node = component.node, None
        if node is not None:
            if isinstance(node, WiredNode):
                node.detach()
            self._executor.remove_node(node)
            _destroy(node)

    def _end(self) -> None:
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
                self.failure = f"has stopped: {type(error).__name__}: {error}"
        finally:
            self._ends = True
            self._wiring.close()
            for component in list(self._components):
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

    def _spin(self) -> None:
        """Until there is a job, which ConditionReachedException says."""
        while True:
            # The bound method is passed, not a lambda: equal arguments keep the generator.
            task, _, node = self._executor.wait_for_ready_callbacks(None, None, self._has_job)
            with self._wiring.lock:
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


def _destroy(node: Node) -> None:
    try:
        node.destroy_node()
    except Exception:  # noqa: BLE001
        # The override of a half-built component may miss what it wants to close.
        with suppress(Exception):
            Node.destroy_node(node)
