"""Runs a graph without launch: a container for each sensor, that of the first in this process."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace

from rclpy.logging import get_logger

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.services import running_container
from cmp_tactile_bringup.graphs.description import (
    CONTAINER,
    Graph,
    argument_list,
    check_recordings,
    with_recordings,
)
from cmp_tactile_bringup.graphs.packaged import find_graph
from cmp_tactile_bringup.graphs.running import RunningLine, pressed_keys
from cmp_tactile_bringup.terminal import shown_stages
from cmp_tactile_processing.cache.files import default_cache_dir, digest, locked
from cmp_tactile_processing.errors import CmpTactileError, InputError
from cmp_tactile_processing.processes import StopSignal, python_command
from cmp_tactile_processing.ros.process import leave_process, report_error, split_ros_args

VIEWER = "cmp_tactile_viewer.nodes.web_viewer"
EXECUTABLES = "cmp_tactile_bringup.container.executables"
END_WITH_STDIN = "--end-with-stdin"
# The exit code, as for a wrong option.
WRONG_ARGUMENT = 2
# How often components and processes are asked whether they failed, s.
CHECK_PERIOD = 0.2

Processes = Mapping[str, "subprocess.Popen[bytes]"]


def run_graph(arguments: Sequence[str], stop: StopSignal) -> int:
    """Run what a command line asks for until a signal comes; the exit code.

    0 after a clean end; 2 for an argument or a file that cannot be used; 1 where it cannot start,
    and where a component fails, which ends the others too.
    arguments: those of the process, its name first.
    """
    own, ros_args = split_ros_args(arguments[1:])
    options = _parser().parse_intermixed_args(own)
    if options.end_with_stdin:
        threading.Thread(target=_wait_for_end_of_stdin, args=(stop,), daemon=True).start()
    try:
        graph = _with_recordings(_load(options), stop)
        if options.only:
            (graph,) = (part for part in graph.by_process() if part.namespace == options.only)
            graph = replace(graph, viewer=None)
        check_recordings(graph)
        first, *others = graph.by_process()
        commands = {
            part.namespace.strip("/"): python_command(
                EXECUTABLES, "standalone", options.config, *options.arguments,
                f"--only={part.namespace}", END_WITH_STDIN, *ros_args,
            )
            for part in others
        }  # fmt: skip
        with (
            _only_one_in(first.namespace),
            # Not missed where it ends by itself, as for a port that is taken: the sensors run on.
            _running(_page(graph)),
            _running(commands) as processes,
            running_container([arguments[0], *ros_args], CONTAINER, first.namespace) as container,
        ):
            code = _run(container, first, stop, processes, watch=options.watch)
    except CmpTactileError as error:
        return WRONG_ARGUMENT if report_error(error) and isinstance(error, InputError) else 1
    return leave_process(code)


def _wait_for_end_of_stdin(stop: StopSignal) -> None:
    # Not by sys.stdin, whose lock a thread must not hold as the interpreter ends.
    while os.read(sys.stdin.fileno(), 1):
        pass
    stop.set()


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
            raise InputError(msg)
        values[name] = value
    return function.load(values)


def _with_recordings(graph: Graph, stop: StopSignal) -> Graph:
    with shown_stages() as show:

        def show_or_stop(what: str, share: float) -> None:
            if stop.by_signal:
                raise SystemExit(0)
            show(what, share)

        return with_recordings(graph, show_or_stop)


@contextmanager
def _only_one_in(namespace: str) -> Iterator[None]:
    """Raise CmpTactileError where a process of this machine runs a graph in the same namespace.

    Their forces and records would be mixed.
    """
    where = f"{platform.node()} {os.environ.get('ROS_DOMAIN_ID') or 0} {namespace}"
    place = default_cache_dir() / "running"
    with ExitStack() as held:
        try:
            place.mkdir(parents=True, exist_ok=True)
            held.enter_context(locked(place / f"{digest(where)[:16]}.lock", wait_s=0.0))
        except TimeoutError:
            msg = (
                f"{namespace}: found a sensor of this name that runs already, expected another "
                "name (name:=NAME)"
            )
            raise CmpTactileError(msg) from None
        except OSError:
            pass  # nothing can be kept: it runs all the same
        yield


@contextmanager
def _running(commands: Mapping[str, Sequence[str]]) -> Iterator[Processes]:
    """A process for each sensor; they end with this one, by their stdin where this one is killed.

    Ctrl-C is for this process, which then ends them.
    """
    with ExitStack() as running:
        processes = {
            name: running.enter_context(
                subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
            )
            for name, command in commands.items()
        }
        try:
            yield processes
        finally:
            # All at once, before each is waited for.
            for process in processes.values():
                process.terminate()


def _page(graph: Graph) -> dict[str, Sequence[str]]:
    """The command of a graph's page, where it has one."""
    if graph.viewer is None:
        return {}
    # JSON's texts are YAML's: a token may be a number.
    given = (f"{name}:={json.dumps(value)}" for name, value in graph.viewer.items())
    words = [word for setting in given for word in ("-p", setting)]
    return {"page": python_command(VIEWER, END_WITH_STDIN, "--ros-args", *words)}


def _run(
    container: ComponentContainer,
    graph: Graph,
    stop: StopSignal,
    others: Processes,
    *,
    watch: bool,
) -> int:
    """Load on a thread of its own, so that a signal ends a slow constructor too.

    others: processes that all end with.  watch: write what the sensor feels while it runs.
    """
    failures: list[str] = []
    loaded = threading.Event()

    def load() -> None:
        try:
            for component in graph.components:
                container.load(component)
            get_logger("standalone").info(f"{len(graph.components)} components are running")
            loaded.set()
        except CmpTactileError as error:
            failures.append(str(error))
        except Exception as error:  # noqa: BLE001  else half a graph would run
            traceback.print_exc()
            failures.append(f"{type(error).__name__}: {error}")

    # A component may end the ROS context, without which nothing runs.
    container.context.on_shutdown(stop.set)
    threading.Thread(target=load, name="loader", daemon=True).start()
    with ExitStack() as shown:
        while not (failures or stop.wait(CHECK_PERIOD)):
            failures += [item.failure for item in container.list().values() if item.failure]
            failures += [
                f"{name}: its process ended with code {process.returncode}"
                for name, process in others.items()
                if process.poll() is not None
            ]
            if watch and loaded.is_set():
                loaded.clear()
                line = shown.enter_context(RunningLine(graph, on_quit=stop.set))
                shown.enter_context(pressed_keys(line.on_key))
    return report_error(failures[0]) if failures and not stop.by_signal else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="standalone", description="Run the components of a graph, a process for each sensor."
    )
    parser.add_argument(
        "config", help="a packaged graph, such as replay, or a Python file with a graph"
    )
    parser.add_argument(
        "arguments", nargs="*", metavar="NAME:=VALUE", help="arguments of the graph"
    )
    parser.add_argument("--only", metavar="NAMESPACE", help="run one sensor of the graph")
    parser.add_argument(END_WITH_STDIN, action="store_true", help="end when stdin is closed")
    parser.add_argument(
        "--watch",
        action="store_true",
        help="show force, contacts and flags of the first sensor while it runs",
    )
    parser.add_argument(
        "--show-args", action="store_true", help="list the arguments of the graph and end"
    )
    return parser
