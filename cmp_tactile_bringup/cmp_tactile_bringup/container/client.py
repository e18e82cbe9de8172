"""Loads the components of a graph into a container that runs in another process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy
from composition_interfaces.srv import LoadNode, UnloadNode
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_bringup.container.component_description import ComponentDescription
from cmp_tactile_bringup.errors import ComponentLoadError
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.process import joining_ros

__all__ = ["ContainerClient", "StoppedError", "container_client"]

FIND_TIMEOUT_S = 10.0
UNLOAD_TIMEOUT_S = 5.0
POLL_S = 0.05


class StoppedError(Exception):
    """The user ended the waiting for an answer."""


class ContainerClient:
    """Asks a container to load components, and to unload them in the end."""

    def __init__(self, node: Node, container: str, is_stopped: Callable[[], bool]) -> None:
        """container: its full name.  is_stopped: ends all waiting."""
        self._container = f"/{container.strip('/')}"
        self._is_stopped = is_stopped
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._load = self._client(node, LoadNode, "load_node")
        self._unload = self._client(node, UnloadNode, "unload_node")
        self._loaded: list[int] = []
        self._loading: Any = None

    @property
    def is_there(self) -> bool:
        """Whether the container still offers its services."""
        return bool(self._load.service_is_ready())

    def find(self, timeout_s: float = FIND_TIMEOUT_S) -> None:
        """Wait for the container; ComponentLoadError where there is none in time."""
        end = time.monotonic() + timeout_s
        while not (self._load.service_is_ready() and self._unload.service_is_ready()):
            self._check_stopped()
            if time.monotonic() > end:
                msg = f"{self._container}: found no such container within {timeout_s:g} s"
                raise ComponentLoadError(msg)
            time.sleep(POLL_S)

    def load(self, component: Component) -> int:
        """Load a component; its id.

        Raises ComponentLoadError where the container refuses it or ends, StoppedError where the
        user does not want to wait any longer.
        """
        self._loading = future = self._load.call_async(_request(component))
        while not future.done():
            self._executor.spin_once(timeout_sec=POLL_S)
            self._check_stopped()
            if not self.is_there:
                msg = f"{self._container}: the container has ended"
                raise ComponentLoadError(msg)
        self._loading = None
        answer: Any = future.result()
        if not answer.success:
            raise ComponentLoadError(answer.error_message)
        self._loaded.append(answer.unique_id)
        return int(answer.unique_id)

    def unload_all(self, timeout_s: float = UNLOAD_TIMEOUT_S) -> None:
        """Unload what was loaded, last first, as far as the container answers in time.

        Also what it was told to load and is still being built.
        """
        end = time.monotonic() + timeout_s
        if self._loading is not None:
            self._await(self._loading, end)
            if self._loading.done() and self._loading.result().success:
                self._loaded.append(self._loading.result().unique_id)
            self._loading = None
        for unique_id in reversed(self._loaded):
            if not self.is_there:
                break
            self._await(self._unload.call_async(UnloadNode.Request(unique_id=unique_id)), end)
        self._loaded.clear()

    def close(self) -> None:
        """Give the node back."""
        self._executor.shutdown()

    def _client(self, node: Node, kind: Any, service: str) -> Client[Any, Any]:
        return node.create_client(kind, f"{self._container}/_container/{service}")

    def _await(self, future: Any, end: float) -> None:
        """Until the container answers, is gone, or it is that late."""
        while not future.done() and self.is_there and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=POLL_S)

    def _check_stopped(self) -> None:
        if self._is_stopped():
            raise StoppedError


@contextmanager
def container_client(
    ros_args: Sequence[str], container: str, is_stopped: Callable[[], bool]
) -> Iterator[ContainerClient]:
    """A client in the default ROS context, which is started for it.

    In the end what it loaded is unloaded.
    """
    with joining_ros():
        rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("standalone", start_parameter_services=False)
    client = ContainerClient(node, container, is_stopped)
    try:
        yield client
    finally:
        client.unload_all()
        client.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _request(component: Component) -> LoadNode.Request:
    description = ComponentDescription.from_graph(component)
    in_process = Parameter("use_intra_process_comms", value=True)
    return LoadNode.Request(
        package_name=description.package,
        plugin_name=description.plugin,
        node_name=description.name,
        node_namespace=description.namespace,
        remap_rules=list(description.remappings),
        parameters=[item.to_parameter_msg() for item in description.parameters],
        extra_arguments=[in_process.to_parameter_msg()],
    )
