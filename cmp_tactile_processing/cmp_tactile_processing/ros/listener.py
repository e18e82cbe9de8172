"""A node of one's own that listens on a thread, beside a command that does something else."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_processing.ros.process import joining_ros

__all__ = ["Listener"]

Self = TypeVar("Self", bound="Listener")


class Listener:
    """A context manager: while it lasts, `node` is spun by a thread, in a context of its own."""

    def __init__(self, node_name: str, namespace: str = "") -> None:
        self._node_name, self._namespace = node_name, namespace
        self._context = Context()

    def __enter__(self: Self) -> Self:
        # The process's own signals end it; rclpy's handlers would end the context first.
        with joining_ros():
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self.node = Node(self._node_name, namespace=self._namespace, context=self._context)
        self._subscribe()
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=self._node_name, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _subscribe(self) -> None:
        """Create the subscriptions of `node`; for subclasses."""

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return
