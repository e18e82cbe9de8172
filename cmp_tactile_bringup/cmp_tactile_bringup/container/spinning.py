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
from functools import partial
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
    """One component, from the building of its node to its end.

    full_name: of the node, once the container has taken that name; empty before.  errors: those of
    its callbacks.  ending: by which error it was ended.
    """

    def __init__(self) -> None:
        self.full_name = ""
        self.unique_id = 0
        self.node: Node | None = None
        self.errors = CallbackErrors()
        self.ending = ""
        self._spinner: Spinner | None = None
        self._lock = threading.Lock()
        self._has_ended = False
        self._gone = threading.Event()

    @property
    def failure(self) -> str:
        """Why the component runs no more, or what its attribute `failure` says; empty where none.

        The one thing of a component that is asked for on other threads.
        """
        return self.ending or str(getattr(self.node, "failure", ""))

    def build(self, component: ComponentClass, arguments: dict[str, Any], spinner: Spinner) -> str:
        """Build the node on this thread, for that of the spinner to run; the node's full name.

        Raises ComponentLoadError where the constructor fails.
        """
        self._spinner = spinner
        try:
            with joining(spinner.wiring):
                self.node = _build(component, arguments)
        except CmpTactileError as error:
            raise ComponentLoadError(str(error)) from None
        except BaseException as error:  # noqa: BLE001  sys.exit must not end the container
            get_logger("component_container").error(traceback.format_exc())
            msg = f"{type(error).__name__}: {error}"
            raise ComponentLoadError(msg) from None
        return self.node.get_fully_qualified_name()

    def run(self, spinner: Spinner) -> None:
        """Spin the node from now on; ComponentLoadError where it was ended meanwhile."""
        spinner.do(partial(spinner.add, self)).result()
        if self.node is None:
            raise ComponentLoadError(self.ending or "the node ended before it ran")

    def request_stop(self) -> None:
        """End after the running callback; returns at once."""
        if self._spinner is None:
            self.end()
        else:
            self._spinner.do(partial(self._spinner.remove, self))

    def join(self, timeout: float) -> bool:
        """Wait for the component to be destroyed; False where it takes longer, in s."""
        return self._gone.wait(timeout)

    def end(self, release: Callable[[], None] = lambda: None) -> None:
        """Destroy the node, on the thread that spins it; release: called before others know."""
        with self._lock:
            if self._has_ended:
                return
            self._has_ended = True
        node, self.node = self.node, None
        if node is not None:
            _destroy(node)
        release()
        self._gone.set()

    def report(self, error: BaseException) -> None:
        """Log the traceback; the same one again and again only once in five seconds."""
        if self.node is None:
            return
        self.errors.report(self.node, error)


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
        self._jobs: SimpleQueue[tuple[Callable[[], None], Future[None]]] = SimpleQueue()
        self._executor = executors.SingleThreadedExecutor(context=context)
        self._ends = self._has_ended = False
        self._thread = threading.Thread(target=self._run, name="component", daemon=True)
        self._thread.start()

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
                    component.ending = f"has stopped: {type(error).__name__}: {error}"
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
            job, done = self._jobs.get()
            try:
                with self.wiring.lock:
                    job()
            finally:
                done.set_result(None)

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


def _destroy(node: Node) -> None:
    try:
        node.destroy_node()
    except Exception:  # noqa: BLE001
        # The override of a half-built component may miss what it wants to close.
        with suppress(Exception):
            Node.destroy_node(node)
