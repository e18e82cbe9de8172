"""Runs a graph file in one container, of this process or of another."""

from __future__ import annotations

import argparse
import sys
import threading
import traceback
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from rclpy.logging import get_logger

from cmp_tactile_bringup.container.client import StoppedError, container_client
from cmp_tactile_bringup.container.component_description import ComponentDescription
from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.running import leave_process, running_container
from cmp_tactile_bringup.errors import ComponentLoadError, GraphError
from cmp_tactile_bringup.graphs.description import Graph
from cmp_tactile_bringup.graphs.recordings import check_recordings, with_recordings
from cmp_tactile_bringup.graphs.run_arguments import GraphRun, all_arguments, read_run
from cmp_tactile_bringup.graphs.running_line import RunningLine
from cmp_tactile_bringup.graphs.shared_files import find_config
from cmp_tactile_bringup.terminal.stages import shown_stages
from cmp_tactile_bringup.terminal.stop_signal import StopSignal
from cmp_tactile_processing.errors import CmpTactileError, printable
from cmp_tactile_processing.ros.process import SecurityError

__all__ = ["load_components", "run_graph"]

# How often the components are asked whether they failed, s.
CHECK_PERIOD = 0.2


def load_components(container: ComponentContainer, graph: Graph) -> dict[str, int]:
    """Load the components of a graph in their order; their ids by full name.

    Raises ComponentLoadError for the first that cannot be loaded; those before it stay.
    """
    ids = {}
    for component in graph.components:
        ids[component.full_name] = container.load(ComponentDescription.from_graph(component))
    return ids


def run_graph(arguments: Sequence[str], stop: StopSignal) -> int:
    """Run what a command line asks for until a signal comes; the exit code.

    0 after a clean end; 1 where it cannot start, and where a component fails, which ends the others
    too.  arguments: those of the process, its name first.
    """
    own, ros_args = _split_ros_args(arguments[1:])
    try:
        run = _read_run(own)
        graph = _with_recordings(run.graph, stop)
        check_recordings(graph)
        ros_args.insert(0, arguments[0])
        if run.container:
            return _run_elsewhere(GraphRun(graph, run.container), ros_args, stop)
    except CmpTactileError as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    except StoppedError:
        return 0
    try:
        with running_container(ros_args, graph.container, graph.namespace) as container:
            code = _run(container, GraphRun(graph, "", run.watch), stop)
    except SecurityError as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    return leave_process(container, code)


def _run_elsewhere(run: GraphRun, ros_args: Sequence[str], stop: StopSignal) -> int:
    """Keep the components in the container of another process until a signal comes."""
    with container_client(ros_args, run.container, lambda: stop.by_signal) as client:
        client.find()
        for component in run.graph.components:
            client.load(component)
        count = len(run.graph.components)
        get_logger("standalone").info(f"{count} components run in {run.container}")
        while not stop.wait(CHECK_PERIOD):
            if not client.is_there:
                msg = f"{run.container}: the container has ended"
                raise ComponentLoadError(msg)
    return 0


def _with_recordings(graph: Graph, stop: StopSignal) -> Graph:
    with shown_stages() as tell:

        def tell_or_stop(what: str, share: float) -> None:
            if stop.by_signal:
                raise StoppedError
            tell(what, share)

        return with_recordings(graph, tell_or_stop)


def _run(container: ComponentContainer, run: GraphRun, stop: StopSignal) -> int:
    """Load on a thread of its own, so that a signal ends a slow constructor too."""
    failures: list[str] = []
    loaded = threading.Event()

    def load() -> None:
        try:
            load_components(container, run.graph)
            get_logger("standalone").info(f"{len(run.graph.components)} components run")
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
            if failures:
                break
            if run.watch and loaded.is_set():
                loaded.clear()
                shown.enter_context(RunningLine(run.graph))
    if failures and not stop.by_signal:
        sys.stderr.write(printable(f"error: {failures[0]}") + "\n")
        return 1
    return 0


def _read_run(arguments: Sequence[str]) -> GraphRun:
    options = _parser().parse_intermixed_args(arguments)
    path = find_config(options.config)
    if options.show_args:
        _show_arguments(path)
    values = {}
    for assignment in options.arguments:
        name, separator, value = assignment.partition(":=")
        if not separator:
            msg = f"found {assignment!r}, expected NAME:=VALUE"
            raise GraphError(msg)
        values[name] = value
    try:
        run = read_run(path, values)
    except GraphError as error:
        if path == Path(options.config).expanduser():
            raise
        # A packaged file is not what is wrong: the arguments that came with its name are.
        raise GraphError(str(error).removeprefix(f"{path}: ")) from None
    graph = run.graph
    for assignment in options.set:
        graph = graph.with_parameter(assignment)
    return GraphRun(graph, run.container, options.watch)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="standalone", description="Run the components of a graph file in one container."
    )
    parser.add_argument("config", help="graph file, or name of a packaged one, such as replay")
    parser.add_argument(
        "arguments", nargs="*", metavar="NAME:=VALUE", help="arguments of the graph file"
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
        "--show-args", action="store_true", help="list the arguments of the graph file and end"
    )
    return parser


def _show_arguments(path: Path) -> None:
    for argument in all_arguments(path):
        default = "required" if argument.default is None else repr(argument.default_text)
        choices = f" (one of {', '.join(argument.allowed)})" if argument.allowed else ""
        sys.stdout.write(f"{argument.name}:={choices}\n")
        sys.stdout.write(f"    {argument.help}\n    default: {default}\n")
    raise SystemExit(0)


def _split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Our own arguments and ROS's, which stand between --ros-args and --.

    rclpy.utilities.remove_ros_args would also take away NAME:=VALUE, the remap rules of old.
    """
    own: list[str] = []
    ros: list[str] = []
    in_ros = False
    for argument in arguments:
        in_ros = in_ros or argument == "--ros-args"
        (ros if in_ros else own).append(argument)
        in_ros = in_ros and argument != "--"
    return own, ros
