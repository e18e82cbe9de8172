"""Other nodes of one name, which ROS allows: two sensors of one name mix their frames.

The graph shows that there are two, but not where: that is in what each reports on /diagnostics.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

PROCESS = "process"
"""Key of a status with the process of its node."""

QUEUE = 100
POLL_S = 0.1
# Within which a node that runs reports at least twice.
REPORTED_S = 2.5


def this_process() -> str:
    """Number of this process, and its machine."""
    return f"{os.getpid()} on {socket.gethostname()}"


class Namesakes:
    """Processes in which nodes report under a name that another node has or wants.

    It listens from the first time on that the graph has such a name.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._since = 0.0
        self._subscription: Any = None
        self._reports: dict[str, tuple[str, float]] = {}

    def process_of(self, full_name: str, own: int = 1) -> str:
        """Where else a node of this name reports; empty where none does, or has not yet.

        own: nodes of that name that are meant to be there.
        """
        if not self._is_namesake(full_name, own):
            return ""
        if self._subscription is None:
            self._since = time.monotonic()
            self._subscription = self._node.create_subscription(
                DiagnosticArray, "/diagnostics", self._on_report, QUEUE
            )
        process, reported = self._reports.get(full_name, ("", 0.0))
        return process if time.monotonic() - reported < REPORTED_S else ""

    def awaited_process_of(self, full_name: str, is_stopped: Callable[[], bool]) -> str:
        """The same of a name that nobody is meant to have, once whoever runs must have reported.

        The graph keeps the nodes of a process that was killed for some seconds, but these report no
        more.  For a thread that does not spin the node.  is_stopped: ends the waiting.
        """
        while not (process := self.process_of(full_name, own=0)):
            listening = self._subscription is not None
            is_late = listening and time.monotonic() - self._since > REPORTED_S
            if is_late or is_stopped() or not self._is_namesake(full_name, 0):
                break
            time.sleep(POLL_S)
        return process

    def _is_namesake(self, full_name: str, own: int) -> bool:
        names = self._node.get_node_names_and_namespaces()
        return sum(f"{space.rstrip('/')}/{name}" == full_name for name, space in names) > own

    def _on_report(self, message: Any) -> None:
        for status in message.status:
            for pair in status.values:
                if pair.key == PROCESS and pair.value != this_process():
                    self._reports[f"/{status.name}"] = pair.value, time.monotonic()
