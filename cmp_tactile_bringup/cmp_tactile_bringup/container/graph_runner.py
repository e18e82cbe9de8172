"""Runs a graph in a container for each sensor, or in one that runs already."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import rclpy
from composition_interfaces.srv import LoadNode, UnloadNode
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_bringup.container.components import ComponentContainer, ros_parameters
from cmp_tactile_bringup.container.services import leave_process, running_container
from cmp_tactile_bringup.errors import ComponentLoadError, GraphError
from cmp_tactile_bringup.graphs.description import Component, Graph, argument_list
from cmp_tactile_bringup.graphs.packaged import find_graph
from cmp_tactile_bringup.graphs.running import RunningLine
from cmp_tactile_bringup.graphs.start import check_recordings, with_recordings
from cmp_tactile_bringup.terminal.output import shown_stages
from cmp_tactile_bringup.terminal.stop_signal import StopSignal
from cmp_tactile_processing.errors import CmpTactileError, printable
from cmp_tactile_processing.python_command import python_command
from cmp_tactile_processing.ros.process import joining_ros, split_ros_args

VIEWER = "cmp_tactile_viewer.nodes.web_viewer"
EXECUTABLES = "cmp_tactile_bringup.container.executables"
# How often the components are asked whether they failed, s.
CHECK_PERIOD = 0.2
FIND_TIMEOUT_S = 10.0
UNLOAD_TIMEOUT_S = 5.0
POLL_S = 0.05


def run_graph(arguments: Sequence[str], stop: StopSignal) -> int:
    """Run what a command line asks for until a signal comes; the exit code.

    0 after a clean end; 1 where it cannot start, and where a component fails, which ends the others
    too.  arguments: those of the process, its name first.
    """
    own, ros_args = split_ros_args(arguments[1:])
    ros_args.insert(0, arguments[0])
    try:
        options = _parser().parse_intermixed_args(own)
        graph = _with_recordings(_load(options), stop)
        check_recordings(graph)
        if graph.joined:
            with _viewer_beside(graph):
                return _run_elsewhere(graph, ros_args, stop)
        graph, others = _of_this_process(graph, options.only_sensor)
        with (
            _viewer_beside(graph if not options.only_sensor else None),
            _OtherSensors(others, arguments[1:], end_with_parent=options.end_with_parent) as also,
            running_container(ros_args, graph.container, graph.namespace) as container,
        ):
            code = _run(container, graph, stop, also, watch=options.watch)
    except CmpTactileError as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    except StoppedError:
        return 0
    return leave_process(container, code)


def _load(options: argparse.Namespace) -> Graph:
    """The graph that a command line asks for."""
    function = find_graph(options.config)
    if options.show_args:
        sys.stdout.write(argument_list(function.arguments))
        raise SystemExit(0)
    values = {}
    for assignment in options.arguments:
        name, separator, value = assignment.partition(":=")
        if not separator:
            msg = f"found {assignment!r}, expected NAME:=VALUE"
            raise GraphError(msg)
        values[name] = value
    graph = function.load(values)
    for assignment in options.set:
        graph = graph.with_parameter(assignment)
    return graph


def _run_elsewhere(graph: Graph, ros_args: Sequence[str], stop: StopSignal) -> int:
    """Keep the components in the container of another process until a signal comes."""
    with container_client(ros_args, graph.joined, lambda: stop.by_signal) as client:
        client.find()
        for component in graph.components:
            client.load(component)
        count = len(graph.components)
        get_logger("standalone").info(f"{count} components run in {graph.joined}")
        while not stop.wait(CHECK_PERIOD):
            if not client.is_there:
                msg = f"{graph.joined}: the container has ended"
                raise ComponentLoadError(msg)
    return 0


def _with_recordings(graph: Graph, stop: StopSignal) -> Graph:
    with shown_stages() as show:

        def show_or_stop(what: str, share: float) -> None:
            if stop.by_signal:
                raise StoppedError
            show(what, share)

        return with_recordings(graph, show_or_stop)


def _of_this_process(graph: Graph, only_sensor: str) -> tuple[Graph, list[str]]:
    """The first sensor's part of a graph and the names of the others, or the one asked for."""
    parts = graph.by_sensor()
    if not only_sensor:
        return parts[0], [part.sensors[0].name for part in parts[1:]]
    by_name = {part.sensors[0].name: part for part in parts if len(part.sensors) == 1}
    if only_sensor not in by_name:
        msg = f"--only-sensor: found {only_sensor!r}, expected one of {', '.join(by_name)}"
        raise GraphError(msg)
    return by_name[only_sensor], []


@contextmanager
def _viewer_beside(graph: Graph | None) -> Iterator[None]:
    """The page of a graph, where it has one, in a process that ends with this one.

    It is not missed where it ends by itself, as for a port that is taken: the sensors run on.
    """
    if graph is None or graph.viewer is None:
        yield
        return
    # JSON's texts are YAML's: a token may be a number.
    given = (f"{name}:={json.dumps(value)}" for name, value in graph.viewer.items())
    words = (word for setting in given for word in ("-p", setting))
    with subprocess.Popen(
        # Also where this process is killed.
        python_command(VIEWER, "--end-with-stdin", "--ros-args", *words),
        stdin=subprocess.PIPE,
        # Ctrl-C is for this process, which then ends that one.
        start_new_session=True,
    ) as process:
        try:
            yield
        finally:
            process.terminate()


class _OtherSensors:
    """The processes in which a graph's sensors run beside that of this process."""

    def __init__(
        self, names: Sequence[str], arguments: Sequence[str], *, end_with_parent: bool
    ) -> None:
        """arguments: those of this process.  end_with_parent: so does this process."""
        self._parent = os.getppid() if end_with_parent else 0
        self._names, self._given = names, [item for item in arguments if item != "--watch"]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> _OtherSensors:
        for name in self._names:
            own = ["--only-sensor", name, "--end-with-parent"]
            # Ctrl-C is for this process, which then ends those.
            self._processes[name] = subprocess.Popen(
                python_command(EXECUTABLES, "standalone", *own, *self._given),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            process.wait()

    def failures(self) -> list[str]:
        """Of processes that have ended by themselves, this one's parent included."""
        found = [
            f"{name}: its process has ended with code {process.returncode}"
            for name, process in self._processes.items()
            if process.poll() is not None
        ]
        if self._parent and os.getppid() != self._parent:
            found.append("the process that started this one has ended")
        return found


def _run(
    container: ComponentContainer,
    graph: Graph,
    stop: StopSignal,
    others: _OtherSensors,
    *,
    watch: bool,
) -> int:
    """Load on a thread of its own, so that a signal ends a slow constructor too.

    watch: write what the first sensor feels while it runs.
    """
    failures: list[str] = []
    loaded = threading.Event()

    def load() -> None:
        try:
            for component in graph.components:
                container.load(component)
            get_logger("standalone").info(f"{len(graph.components)} components run")
            loaded.set()
        except CmpTactileError as error:
            failures.append(str(error))
            stop.set()
        except Exception as error:  # noqa: BLE001  else half a graph would run
            traceback.print_exc()
            failures.append(f"{type(error).__name__}: {error}")
            stop.set()

    # A component may end the ROS context, without which nothing runs.
    container.context.on_shutdown(stop.set)
    threading.Thread(target=load, name="loader", daemon=True).start()
    with ExitStack() as shown:
        while not stop.wait(CHECK_PERIOD):
            failures += [item.failure for item in container.list() if item.failure]
            failures += others.failures()
            if failures:
                break
            if watch and loaded.is_set():
                loaded.clear()
                shown.enter_context(RunningLine(graph, on_quit=stop.set))
    if failures and not stop.by_signal:
        sys.stderr.write(printable(f"error: {failures[0]}") + "\n")
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="standalone", description="Run the components of a graph, a process for each sensor."
    )
    parser.add_argument(
        "config", help="name of a packaged graph, such as replay, or a Python file with a graph"
    )
    parser.add_argument(
        "arguments", nargs="*", metavar="NAME:=VALUE", help="arguments of the graph"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="COMPONENT.PARAMETER=VALUE",
        help="set a parameter of a component; may be repeated",
    )
    parser.add_argument(
        "--watch",
        action="store_true",
        help="write what the first sensor feels while it runs; not with container:=",
    )
    parser.add_argument(
        "--only-sensor",
        default="",
        metavar="NAME",
        help="run this sensor of the graph alone; else each has a process",
    )
    parser.add_argument("--end-with-parent", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument(
        "--show-args", action="store_true", help="list the arguments of the graph and end"
    )
    return parser


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

        Also what is still being built.
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
    in_process = Parameter("use_intra_process_comms", value=component.intra_process)
    return LoadNode.Request(
        package_name=component.package,
        plugin_name=component.plugin,
        node_name=component.name,
        node_namespace=component.namespace,
        remap_rules=[f"{old}:={new}" for old, new in component.remappings.items()],
        parameters=[item.to_parameter_msg() for item in ros_parameters(component)],
        log_level=component.log_level,
        extra_arguments=[in_process.to_parameter_msg()],
    )
