"""A container that other processes can use: the three services of composition_interfaces."""

from __future__ import annotations

import faulthandler
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import rclpy
from composition_interfaces.srv import ListNodes, LoadNode, UnloadNode
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.spinning import LoadedComponent
from cmp_tactile_bringup.errors import ComponentError, ComponentLoadError
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.base_nodes import SERVICE_QOS
from cmp_tactile_processing.ros.diagnostics.status import ERROR, OK, status_message, status_name
from cmp_tactile_processing.ros.process import JoinError, joining_ros, leave_at_once

ERROR_PAUSE_S = 0.1
ERROR_LOG_PERIOD_S = 5.0

INTRA_PROCESS = "use_intra_process_comms"

SWITCH_INTERVAL = 5e-4
"""How long a thread may compute in Python while others wait, s.

Python's own 5 ms are a third of the time in which a frame goes through all components.
"""

END_TIMEOUT = 10.0
"""After which a process that does not come to its end is left as it is, s."""


@contextmanager
def running_container(
    args: Sequence[str], name: str = "component_container", namespace: str = ""
) -> Iterator[ComponentContainer]:
    """A container with its services, in the default ROS context, which is started for it.

    args: the process's arguments, whose ROS arguments may rename the container's node.
    At the end all components and the container's node are destroyed, then the context ends.
    Raises JoinError for wrong ROS arguments, and where ROS cannot be joined as securely as asked.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        with joining_ros():
            rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
            container = ComponentContainer()
            services = ContainerServices(container, name, namespace)
    except JoinError:
        rclpy.try_shutdown()
        sys.setswitchinterval(interval)
        raise
    try:
        yield container
    finally:
        watch = threading.Timer(END_TIMEOUT, _leave_stuck)
        watch.daemon = True
        watch.start()
        container.shutdown()
        services.close()
        rclpy.try_shutdown()
        watch.cancel()
        sys.setswitchinterval(interval)


def _leave_stuck() -> None:
    sys.stderr.write(f"The end took more than {END_TIMEOUT:g} s; what is still running:\n")
    faulthandler.dump_traceback(file=sys.stderr)
    leave_at_once(0)


class ContainerServices:
    """Offers `~/_container/load_node`, `unload_node` and `list_nodes` for a container.

    Each request has a thread of its own while it is served: a slow constructor holds up no other.
    What could not be loaded stays in the diagnostics until it is: launch goes on without it.
    Arguments of the process (`-r __node:=`, `-r __ns:=`) take precedence over name and namespace.

    node: the container's own.
    """

    def __init__(self, container: ComponentContainer, name: str, namespace: str = "") -> None:
        self._container = container
        self._refused: dict[str, str] = {}
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
        self._executor = SingleThreadedExecutor(context=container.context)
        self._executor.add_node(self.node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name="container_services", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Serve no more and destroy the node.  Ends the spinning thread before the executor."""
        self._stop.set_result(None)
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()

    def _spin(self) -> None:
        while self.node.context.ok() and not self._stop.done():
            self._spin_until_error()

    def _spin_until_error(self) -> None:
        try:
            self._executor.spin_until_future_complete(self._stop)
        except ExternalShutdownException:
            pass
        except Exception:  # noqa: BLE001  without its services nobody can reach the container
            if self.node.context.ok():
                self.node.get_logger().error(
                    traceback.format_exc(), throttle_duration_sec=ERROR_LOG_PERIOD_S
                )
                # An error that stays must leave the cores to the components.
                time.sleep(ERROR_PAUSE_S)

    def _served(self, callback: Callable[[Any, Any], None]) -> Callable[[Any, Any], Any]:
        """Answers every request, with what was raised where the callback cannot."""

        def work(request: Any, response: Any, done: Future[None]) -> None:
            try:
                callback(request, response)
            except Exception as error:  # noqa: BLE001  whoever asks gets an answer
                self.node.get_logger().error(traceback.format_exc())
                if hasattr(response, "error_message"):
                    response.success = False
                    response.error_message = f"{type(error).__name__}: {error}"
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
        for argument in request.extra_arguments:
            if argument.name != INTRA_PROCESS:
                text = f"{request.plugin_name}: extra argument {argument.name!r} has no effect here"
                self.node.get_logger().warning(text)
        wanted = f"{request.node_namespace}/{request.node_name or request.plugin_name}".strip("/")
        try:
            response.unique_id = self._container.load(_component(request))
        except ComponentError as error:
            response.error_message = str(error)
            if request.node_name:
                self._refused[wanted] = str(error)
            self.node.get_logger().error(f"cannot load {error}")
            return
        self._refused.pop(wanted, None)
        response.success = True
        names = {item.unique_id: item.full_name for item in self._container.list()}
        response.full_node_name = names.get(response.unique_id, "")
        self.node.get_logger().info(f"loaded {response.full_node_name}, id {response.unique_id}")

    def _on_unload(self, request: Any, response: Any) -> None:
        try:
            self._container.unload(request.unique_id)
        except ComponentError as error:
            response.error_message = str(error)
            return
        response.success = True

    def _on_list(self, _request: Any, response: Any) -> None:
        components = self._container.list()
        response.full_node_names = [item.full_name for item in components]
        response.unique_ids = [item.unique_id for item in components]

    def _publish_diagnostics(self) -> None:
        container = status_name(self.node)
        running = self._container.list()
        statuses = [_status(container, item) for item in running]
        names = {item.full_name.strip("/") for item in running}
        statuses += [
            status_message(f"{container}: {wanted}", _sensor_of(wanted), (ERROR, reason), {})
            for wanted, reason in dict(self._refused).items()
            if wanted not in names
        ]
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(message)


def _status(container: str, item: LoadedComponent) -> DiagnosticStatus:
    component = item.full_name.lstrip("/")
    summary = OK, "running"
    if item.failure:
        summary = ERROR, item.failure
    elif item.errors.count:
        summary = ERROR, f"{item.errors.count} callbacks raised, last: {item.errors.last}"
    values = {"id": item.unique_id, "callback errors": item.errors.count}
    return status_message(f"{container}: {component}", _sensor_of(component), summary, values)


def _sensor_of(component: str) -> str:
    """A sensor's namespace is its name."""
    return component.rpartition("/")[0] or "none"


def _component(request: Any) -> Component:
    remappings: dict[str, str] = {}
    for rule in request.remap_rules:
        old, sign, new = rule.partition(":=")
        if not sign:
            msg = f"{request.plugin_name}: remap rule: found {rule!r}, expected FROM:=TO"
            raise ComponentLoadError(msg)
        # As in ROS, the first rule of a name counts.
        remappings.setdefault(old, new)
    return Component(
        package=request.package_name,
        plugin=request.plugin_name,
        name=request.node_name,
        namespace=request.node_namespace,
        remappings=remappings,
        parameters={item.name: _parameter(item) for item in request.parameters},
        log_level=request.log_level,
        intra_process=_intra_process(request.extra_arguments),
    )


def _parameter(message: Any) -> Parameter[Any]:
    try:
        return Parameter.from_parameter_msg(message)
    except (TypeError, ValueError) as error:
        msg = f"parameter {message.name!r}: {error}"
        raise ComponentLoadError(msg) from None


def _intra_process(arguments: Any) -> bool:
    """Whether messages are to be handed over; they are unless the request says no."""
    for argument in arguments:
        if argument.name == INTRA_PROCESS:
            value = _parameter(argument).value
            if not isinstance(value, bool):
                msg = f"extra argument {INTRA_PROCESS}: found {value!r}, expected true or false"
                raise ComponentLoadError(msg)
            return value
    return True
