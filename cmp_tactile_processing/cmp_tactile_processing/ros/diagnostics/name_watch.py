"""Finds a node of another process that has the same full name.

ROS lets two nodes have one name.  Two sensors of one name mix their frames, and both answer one
another's services.  The graph shows that there are two, but not where: that is in what each reports
on /diagnostics.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

__all__ = [
    "DISCOVERY_S",
    "PROCESS",
    "NameWatch",
    "NamesInUse",
    "process_of",
    "this_process",
    "times_named",
]

PROCESS = "process"
"""Key of a status with the process of its node."""

QUEUE = 100
POLL_S = 0.1
DISCOVERY_S = 1.0
"""Within which a new node knows those of running processes."""

# Within which a node that runs reports at least twice.
LISTEN_S = 2.5
# As long as what was heard counts for other names, which are mostly of the same graph.
HEARD_S = 10.0


def this_process() -> str:
    """Number of this process, and its machine."""
    return f"{os.getpid()} on {socket.gethostname()}"


def times_named(node: Node, full_name: str) -> int:
    """How many nodes of the graph have this full name, also such that were killed a moment ago."""
    names = node.get_node_names_and_namespaces()
    return sum(f"{space.rstrip('/')}/{name}" == full_name for name, space in names)


def process_of(message: Any, full_name: str) -> str:
    """Where else than here a node of this name reports from; empty where it does not."""
    for status in message.status:
        if f"/{status.name}" == full_name:
            for pair in status.values:
                if pair.key == PROCESS and pair.value != this_process():
                    return str(pair.value)
    return ""


class NamesInUse:
    """Knows the processes of running nodes, before others of the same names are started."""

    def __init__(self, node: Node, discovery_s: float) -> None:
        """node: sees the graph.  discovery_s: how long from now on until it knows all, s."""
        self._node = node
        self._discovered = time.monotonic() + discovery_s
        self._one_at_a_time = threading.Lock()
        self._reports: list[DiagnosticArray] = []
        self._heard_until = -HEARD_S

    def process_of(self, full_name: str, is_stopped: Callable[[], bool]) -> str:
        """Where another process runs a node of this name; empty where none does.

        Waits for the graph to be known, and where it has the name, for a report: the graph keeps
        the nodes of a process that was killed for some seconds.  is_stopped: ends all waiting.
        """
        with self._one_at_a_time:
            while time.monotonic() < self._discovered and not is_stopped():
                time.sleep(POLL_S)
            if is_stopped() or not times_named(self._node, full_name):
                return ""
            kept = time.monotonic() <= self._heard_until + HEARD_S
            if not kept or self._heard(full_name):
                # What was heard before may have ended since.
                self._listen(full_name, is_stopped)
            return self._heard(full_name)

    def _heard(self, full_name: str) -> str:
        return next(filter(None, (process_of(item, full_name) for item in self._reports)), "")

    def _listen(self, full_name: str, is_stopped: Callable[[], bool]) -> None:
        """Until the name is heard or gone, or all that run must have been heard."""
        self._reports.clear()
        # Of its own: nobody else is to wait, nor to be woken by reports later.
        node = Node(
            f"_names_in_use_{os.getpid()}",
            context=self._node.context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(node)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._reports.append, QUEUE)
        until = time.monotonic() + LISTEN_S
        try:
            while not self._heard(full_name) and times_named(self._node, full_name):
                if is_stopped():
                    break
                if time.monotonic() > until:
                    self._heard_until = until
                    break
                with suppress(ExternalShutdownException):  # a signal ends all meanwhile
                    executor.spin_once(POLL_S)
        finally:
            executor.shutdown()
            node.destroy_node()


class NameWatch:
    """Whether the name of a node is its own; `report` is called once for each other process."""

    def __init__(self, node: Node, report: Callable[[str], None]) -> None:
        self._node, self._report = node, report
        self._reports: Any = None
        self._reported: set[str] = set()
        self._problem = ""

    def check(self) -> str:
        """What is wrong, in one line; empty where the name is its own."""
        if times_named(self._node, self._node.get_fully_qualified_name()) < 2:
            self._stop()
        elif self._reports is None:
            self._reports = self._node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_report, QUEUE
            )
        return self._problem

    def _stop(self) -> None:
        self._problem = ""
        self._reported.clear()
        if self._reports is not None:
            self._node.destroy_subscription(self._reports)
            self._reports = None

    def _on_report(self, message: Any) -> None:
        name = self._node.get_fully_qualified_name()
        process = process_of(message, name)
        if process:
            self._problem = (
                f"{name} runs in process {process}, too, beside process {this_process()} here: "
                "two sensors of one name mix their frames; end one or give it another namespace"
            )
        if process and process not in self._reported:
            self._reported.add(process)
            self._report(self._problem)
