"""Finds a sensor whose nodes run in other processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient

from cmp_tactile_processing.errors import CmpTactileError

__all__ = ["RunningSensor", "RunningSensorError", "find_sensor"]

SPLITTER = "view_splitter"
SEARCH_TIME_S = 5.0
ANSWER_TIME_S = 5.0
POLL_S = 0.05

T = TypeVar("T")


class RunningSensorError(CmpTactileError):
    """No sensor runs, or several do where one is meant."""


@dataclass(frozen=True)
class RunningSensor:
    """A sensor's namespace, and the parameters of its nodes; empty where they do not tell."""

    namespace: str
    description: str = ""
    name: str = ""


def find_sensor(node: Node, namespace: str = "") -> RunningSensor:
    """The sensor of a namespace, or the only one that runs.  node: of the one who asks.

    Waits some seconds for it.  Raises RunningSensorError where there is none, or several.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    try:
        wanted = f"/{namespace.strip('/')}" if namespace else ""
        spaces = _polled(executor, SEARCH_TIME_S, lambda: _namespaces(node, wanted))
        if not spaces:
            where = f"in {wanted}" if wanted else "in any namespace"
            msg = f"found no {SPLITTER} {where}, expected a sensor that runs (ROS_DOMAIN_ID?)"
            raise RunningSensorError(msg)
        if len(spaces) > 1:
            msg = f"found several sensors, name one by --namespace: {', '.join(spaces)}"
            raise RunningSensorError(msg)
        return _described(node, executor, spaces[0])
    finally:
        executor.shutdown()


def _namespaces(node: Node, wanted: str) -> list[str]:
    found = {space for name, space in node.get_node_names_and_namespaces() if name == SPLITTER}
    return sorted(space for space in found if wanted in ("", space))


def _described(node: Node, executor: SingleThreadedExecutor, namespace: str) -> RunningSensor:
    client = AsyncParameterClient(node, f"{namespace.rstrip('/')}/{SPLITTER}")
    if not _polled(executor, ANSWER_TIME_S, client.services_are_ready):
        return RunningSensor(namespace)
    future = client.get_parameters(["sensor_description", "sensor_name"])
    _polled(executor, ANSWER_TIME_S, future.done)
    answer = future.result() if future.done() else None
    values = [value.string_value for value in answer.values] if answer is not None else []
    return RunningSensor(namespace, *values)


def _polled(executor: SingleThreadedExecutor, timeout_s: float, ask: Callable[[], T]) -> T:
    """What `ask` says once it says something, or at last."""
    end = time.monotonic() + timeout_s
    while not (answer := ask()) and time.monotonic() < end:
        executor.spin_once(timeout_sec=POLL_S)
    return answer
