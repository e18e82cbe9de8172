"""Runs nodes: one as a process, or one that listens on a thread beside a command."""

from __future__ import annotations

import gc
import os
import re
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.context import Context
from rclpy.exceptions import ParameterException
from rclpy.executors import (
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
)
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_processing.errors import CmpTactileError, printable

REPEAT_S = 0.5
LOGGED_S = 5.0


EXPECTED = {
    "remap rule": "FROM:=TO",
    "parameter override rule": "NAME:=VALUE",
    "log level": "debug, info, warn, error or fatal",
}
MOST_DOMAIN = 232
"""A higher one has no UDP ports (7400 + 250 x domain; DDSI-RTPS 2.5, 9.6.1.1)."""
_NOT_PARSED = re.compile(r"Couldn't parse ([\w ]+): '([^']*)'")


class JoinError(CmpTactileError):
    """ROS refuses this process: its arguments, its domain, or as it cannot protect the graph."""


@contextmanager
def joining_ros() -> Iterator[None]:
    """Names in one line why the ROS context or the first node cannot be made.

    Raises JoinError for ROS arguments that cannot be read, for ROS_DOMAIN_ID, and where
    ROS_SECURITY_ENABLE asks for what the middleware lacks.  What rcl says has several lines, or
    only "error not set"; of domains it takes 5.5 for 5 and -1 for 0.
    """
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isascii() and domain.isdecimal() and int(domain) <= MOST_DOMAIN):
        msg = f"ROS_DOMAIN_ID: found {domain!r}, expected a whole number from 0 to {MOST_DOMAIN}"
        raise JoinError(msg)
    try:
        with warnings.catch_warnings():
            # Of the half-made node.
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    except RCLError as error:
        if found := _NOT_PARSED.search(str(error)):
            what, text = found.groups()
            msg = f"{what}: found '{text}', expected {EXPECTED.get(what, 'a ROS argument')}"
        elif os.environ.get("ROS_SECURITY_ENABLE") == "true":
            msg = (
                "ROS_SECURITY_ENABLE=true: found no secure connection to the ROS graph; the Fast "
                "DDS of the Python wheels has no security, use a ROS 2 of the system: "
                f"{' '.join(str(error).split())}"
            )
        else:
            raise
        raise JoinError(msg) from None


def split_ros_args(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
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


def init_beside(context: Context) -> None:
    """Initialise a context of a program's own, with the ROS arguments of its command line.

    The program's own signal handlers end it; rclpy's would end the context first.
    """
    # By itself rclpy takes arguments of ours, such as view:=true, for remap rules and warns.
    _, ros_args = split_ros_args(sys.argv[1:])
    rclpy.init(args=ros_args, context=context, signal_handler_options=SignalHandlerOptions.NO)


class LastingExecutor(SingleThreadedExecutor):
    """Goes on after a callback that raised, as by a request that rclpy itself cannot read."""

    def spin(self) -> None:
        """Until it or its context is shut down; logs what callbacks raise."""
        before = ""
        with suppress(ShutdownException):
            while self.context.ok():
                callback, _, node = self.wait_for_ready_callbacks()
                callback()
                error = callback.exception()
                # A signal shuts the context down first; what then fails in rcl is part of the end.
                if error is None or not self.context.ok():
                    continue
                trace = "".join(traceback.format_exception(error))
                text = f"a callback raised an exception; the node continues\n{trace}"
                log_raised(node, text, is_known=trace == before)
                before = trace


def log_raised(node: Node | None, text: str, *, is_known: bool) -> None:
    """Log what a callback of a node raised; what is known already only once in five seconds."""
    logger = get_logger("rclpy") if node is None else node.get_logger()
    if is_known:
        logger.error(text, throttle_duration_sec=LOGGED_S)
    else:
        logger.error(text)


def spare_the_collector() -> None:
    """Let the garbage collector pass over all that there is by now; to be called once it is built.

    It would look through the libraries' objects again and again, 170,000 of them in 0.1 to 0.2 s,
    in which no frame is worked at.  What is made from now on is collected as ever.
    """
    gc.freeze()


def run_node(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT, SIGTERM, SIGHUP or shutdown; the exit code.  For the main thread.

    0 after a clean end; 1, with one line on stderr, where the node cannot start as it is set up.
    """
    node = executor = None
    before = frozenset(threading.enumerate())
    try:
        with _interruptible():
            with joining_ros():
                rclpy.init(args=args)
                node = make_node()
            spare_the_collector()
            executor = LastingExecutor()
            executor.add_node(node)
            executor.spin()
    except (CmpTactileError, ParameterException) as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        # A signal shuts the context down first; whatever then fails in rcl is part of the end.
        if rclpy.ok():
            raise
    finally:
        if executor is not None:
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return leave_process(0, before)


def leave_process(code: int, threads_before: frozenset[threading.Thread]) -> int:
    """The exit code, once no thread runs any more that was not there before.

    A constructor or callback that is still busy, or a model that is still being built, would keep
    the interpreter from ending, or crash it; the process then ends at once.
    """
    if frozenset(threading.enumerate()) - threads_before:
        leave_at_once(code)
    return code


def leave_at_once(code: int) -> None:
    """End the process without the interpreter's clean-up."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP raise KeyboardInterrupt here, also in a constructor that compiles.

    Python drops an exception that is raised within a finaliser, and a compiler runs many of them:
    the interrupt is repeated until it comes through, and no traceback is printed for the lost ones.
    rclpy passes SIGINT and SIGTERM on to these handlers.
    """
    report_unraisable = sys.unraisablehook

    def report(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            report_unraisable(unraisable)

    def interrupt(number: int, _frame: FrameType | None) -> None:
        if number == signal.SIGHUP:
            # A shell and the kernel send one each: the second must not disturb the end.
            before[number] = signal.SIG_IGN
            signal.signal(number, signal.SIG_IGN)
        signal.setitimer(signal.ITIMER_REAL, REPEAT_S)
        raise KeyboardInterrupt

    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGALRM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as `nohup` has it
        numbers.append(signal.SIGHUP)
    before: dict[int, Any] = {number: signal.signal(number, interrupt) for number in numbers}
    sys.unraisablehook = report
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = report_unraisable


Self = TypeVar("Self", bound="Listener")


class Listener:
    """A context manager: while it lasts, `node` is spun by a thread, in a context of its own."""

    def __init__(self, node_name: str, namespace: str = "") -> None:
        self._node_name, self._namespace = node_name, namespace
        self._context = Context()

    def __enter__(self: Self) -> Self:
        with joining_ros():
            init_beside(self._context)
            self.node = Node(self._node_name, namespace=self._namespace, context=self._context)
        self._subscribe()
        self._executor = LastingExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, name=self._node_name, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        self._context.try_shutdown()

    def _subscribe(self) -> None:
        """Create the subscriptions of `node`; for subclasses."""

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return
