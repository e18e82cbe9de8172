"""Finds a node of another process that has the same full name.

ROS lets two nodes have one name.  Two sensors of one name mix their frames, and both answer one
another's services.  The graph tells that there are two, but not where: that is in what each reports
on /diagnostics.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

__all__ = ["PROCESS", "NameWatch", "process_of", "this_process", "times_named"]

PROCESS = "process"
"""Key of a status under which it tells where its node runs."""

QUEUE = 100


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


class NameWatch:
    """Whether the name of a node is its own; `tell` is told once of each other process."""

    def __init__(self, node: Node, tell: Callable[[str], None]) -> None:
        self._node, self._tell = node, tell
        self._reports: Any = None
        self._told: set[str] = set()
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
        self._told.clear()
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
        if process and process not in self._told:
            self._told.add(process)
            self._tell(self._problem)
