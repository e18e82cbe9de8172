"""A container that other processes can use: the three services of composition_interfaces."""

from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import rclpy
from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from cmp_tactile_bringup.container.components import ComponentContainer, LoadedComponent
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.errors import CmpTactileError, Finding, Severity
from cmp_tactile_processing.ros.base_nodes import SERVICE_QOS
from cmp_tactile_processing.ros.diagnostics import status_message, status_name
from cmp_tactile_processing.ros.process import LastingExecutor, joining_ros

INTRA_PROCESS = "use_intra_process_comms"

SWITCH_INTERVAL = 5e-4
"""How long a thread may compute in Python while others wait, s.

Python's own 5 ms are a third of the time in which a frame goes through all components.
"""


@contextmanager
def running_container(
    args: Sequence[str], name: str = "component_container", namespace: str = ""
) -> Iterator[ComponentContainer]:
    """A container with its services, in the default ROS context, which is started for it.

    args: the process's arguments, whose ROS arguments may rename the container's node.
    At the end all components and the container's node are destroyed, then the context ends.
    Raises CmpTactileError for wrong ROS arguments, and where ROS cannot be joined as securely as
    asked.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        with joining_ros():
            rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
            container = ComponentContainer()
            services = ContainerServices(container, name, namespace)
        try:
            yield container
        finally:
            container.shutdown()
            services.close()
    finally:
        rclpy.try_shutdown()
        sys.setswitchinterval(interval)


class ContainerServices:
    """Offers `~/_container/load_node`, `unload_node` and `list_nodes` for a container.

    Each request has a thread of its own while it is served: `ros2 component list` does not wait
    for a slow constructor.
    Arguments of the process (`-r __node:=`, `-r __ns:=`) take precedence over name and namespace.

    node: the container's own.
    """

    def __init__(self, container: ComponentContainer, name: str, namespace: str = "") -> None:
        self._container = container
        self.node = Node(name, namespace=namespace, context=container.context)
        group = ReentrantCallbackGroup()
        for kind, topic, callback in (
            (LoadNode, "load_node", self._on_load),
            (UnloadNode, "unload_node", self._on_unload),
            (ListNodes, "list_nodes", self._on_list),
        ):
            service = f"~/_container/{topic}"
            self.node.create_service(
                kind,
                service,
                self._served(callback),
                qos_profile=SERVICE_QOS,
                callback_group=group,
            )
        self._diagnostics = self.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.node.create_timer(1.0, self._publish_diagnostics, callback_group=group)
        self._executor = LastingExecutor(context=container.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name="container_services", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Serve no more and destroy the node; a request that is still served gets no answer."""
        self._executor.shutdown(timeout_sec=0)
        self._thread.join()
        self.node.destroy_node()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def _served(self, callback: Callable[[Any, Any], None]) -> Callable[[Any, Any], Any]:
        """Answers every request; loading and unloading with what was raised where they failed."""

        def work(request: Any, response: Any, done: Future[None]) -> None:
            try:
                callback(request, response)
            except CmpTactileError as error:
                response.error_message = str(error)
                self.node.get_logger().error(str(error))
            except Exception as error:  # noqa: BLE001  whoever asks gets an answer
                response.error_message = f"{type(error).__name__}: {error}"
                self.node.get_logger().error(traceback.format_exc())
            done.set_result(None)
            with suppress(Exception):  # the container ends meanwhile
                self._executor.wake()

        async def answer(request: Any, response: Any) -> Any:
            done: Future[None] = Future()
            threading.Thread(target=work, args=(request, response, done), daemon=True).start()
            await done
            return response

        return answer

    def _on_load(self, request: Any, response: Any) -> None:
        response.unique_id = self._container.load(_component(request))
        response.success = True
        response.full_node_name = self._container.list()[response.unique_id].full_name
        self.node.get_logger().info(f"loaded {response.full_node_name}, id {response.unique_id}")

    def _on_unload(self, request: Any, response: Any) -> None:
        self._container.unload(request.unique_id)
        response.success = True

    def _on_list(self, _request: Any, response: Any) -> None:
        components = self._container.list()
        response.full_node_names = [item.full_name for item in components.values()]
        response.unique_ids = list(components)

    def _publish_diagnostics(self) -> None:
        container = status_name(self.node)
        running = self._container.list().items()
        statuses = [_status(container, unique_id, item) for unique_id, item in running]
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _status(container: str, unique_id: int, item: LoadedComponent) -> DiagnosticStatus:
    component = item.full_name.lstrip("/")
    finding = Finding(Severity.OK, "running")
    if item.failure:
        finding = Finding(Severity.ERROR, item.failure)
    elif item.errors.count:
        text = f"{item.errors.count} callbacks raised, last: {item.errors.last}"
        finding = Finding(Severity.ERROR, text)
    values = {"id": unique_id, "callback errors": item.errors.count}
    # A sensor's namespace is its name.
    sensor = component.rpartition("/")[0] or "none"
    return status_message(f"{container}: {component}", sensor, finding, values)


def _component(request: Any) -> Component:
    remappings: dict[str, str] = {}
    for rule in request.remap_rules:
        old, sign, new = rule.partition(":=")
        if not sign:
            msg = f"{request.plugin_name}: remap rule: found {rule!r}, expected FROM:=TO"
            raise CmpTactileError(msg)
        # As in ROS, the first rule of a name counts.
        remappings.setdefault(old, new)
    extra = {item.name: item.value.bool_value for item in request.extra_arguments}
    return Component(
        package=request.package_name,
        plugin=request.plugin_name,
        name=request.node_name,
        namespace=request.node_namespace,
        remappings=remappings,
        parameters={item.name: Parameter.from_parameter_msg(item) for item in request.parameters},
        log_level=request.log_level,
        intra_process=extra.get(INTRA_PROCESS, True),
    )
