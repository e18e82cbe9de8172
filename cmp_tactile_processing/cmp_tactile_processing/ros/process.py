"""Runs nodes: one as a process, or one that listens on a thread beside a command."""

from __future__ import annotations

import errno
import gc
import os
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NoReturn, TypeVar

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

from cmp_tactile_processing.cache.files import expanded_path, folder_without_home
from cmp_tactile_processing.errors import CmpTactileError, error_text
from cmp_tactile_processing.processes import Interruption

LOGGED_S = 5.0
HIGHEST_DOMAIN = 232

Self = TypeVar("Self", bound="Listener")


@contextmanager
def joining_ros() -> Iterator[None]:
    """Within it, an error says in one line why the ROS context or the first node cannot be made.

    What rcl says has several lines, and places in its source.
    """
    _check_domain()
    _check_keystore()
    _provide_log_folder()
    try:
        with warnings.catch_warnings():
            # Of the half-made node.
            warnings.simplefilter("ignore", RuntimeWarning)
            yield
    except RCLError as error:
        reason = " ".join(str(error).partition(", at ")[0].split())
        msg = f"found no way into ROS: {reason}"
        raise CmpTactileError(msg) from None


def _check_domain() -> None:
    """Refuse what rcl reads otherwise: -1 as 0, 5.5 as 5; above 232 Fast DDS ends the process."""
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    if domain and not (domain.isascii() and domain.isdecimal() and int(domain) <= HIGHEST_DOMAIN):
        msg = f"ROS_DOMAIN_ID: found {domain}, expected a whole number from 0 to {HIGHEST_DOMAIN}"
        raise CmpTactileError(msg)


def _check_keystore() -> None:
    """Refuse security that is enforced without a keystore: rcl says "error not set"."""
    enforced = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    is_enforced = all(os.environ.get(name) == value for name, value in enforced.items())
    if is_enforced and not os.environ.get("ROS_SECURITY_KEYSTORE"):
        reason = " and ".join(f"{name}={value}" for name, value in enforced.items())
        msg = f"ROS_SECURITY_KEYSTORE: found nothing, expected a keystore because of {reason}"
        raise CmpTactileError(msg)


def _provide_log_folder() -> None:
    """Log among temporary files where ~/.ros/log cannot be written; ROS itself would not start.

    As without HOME (a systemd service), or with HOME=/ (`docker run --user 2000`).
    Raises CmpTactileError for a folder that the user has set.
    """
    for variable, inside in (("ROS_LOG_DIR", ""), ("ROS_HOME", "log")):
        if given := os.environ.get(variable):
            reason = _why_not_writable(expanded_path(given) / inside)
            if reason:
                expected = "a folder for logs that can be written"
                msg = f"{variable}: found {given} ({reason}), expected {expected}"
                raise CmpTactileError(msg)
            return
    home = os.environ.get("HOME")
    if not home or _why_not_writable(Path(home, ".ros", "log")):
        os.environ["ROS_LOG_DIR"] = str(folder_without_home() / "log")


def _why_not_writable(folder: Path) -> str:
    """Why a folder cannot be made or written into; empty where it can.

    ROS itself reports the number of an error.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return error.strerror or str(error)
    return "" if os.access(folder, os.W_OK | os.X_OK) else os.strerror(errno.EACCES)


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


class CallbackErrors:
    """What callbacks of a node raised: `count` of them, and `last` in one line."""

    def __init__(self) -> None:
        self.count = 0
        self.last = self._last_traceback = ""

    def report(self, node: Node | None, error: BaseException) -> None:
        """Log the traceback; the same one again and again only once in five seconds."""
        trace = "".join(traceback.format_exception(error))
        self.count += 1
        is_known, self._last_traceback = trace == self._last_traceback, trace
        self.last = trace.strip().rpartition("\n")[2]
        logger = get_logger("rclpy") if node is None else node.get_logger()
        text = f"a callback raised an exception (number {self.count}); the node continues\n{trace}"
        if is_known:
            logger.error(text, throttle_duration_sec=LOGGED_S)
        else:
            logger.error(text)


class LastingExecutor(SingleThreadedExecutor):
    """Goes on after a callback that raised, as by a request that rclpy itself cannot read."""

    def spin(self) -> None:
        """Until it or its context is shut down; logs what callbacks raise."""
        errors = CallbackErrors()
        with suppress(ShutdownException):
            while self.context.ok():
                callback, _, node = self.wait_for_ready_callbacks()
                callback()
                error = callback.exception()
                # A signal shuts the context down first; what then fails in rcl is part of the end.
                if error is not None and self.context.ok():
                    errors.report(node, error)


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
    try:
        with Interruption():
            with joining_ros():
                rclpy.init(args=args)
                node = make_node()
            spare_the_collector()
            executor = LastingExecutor()
            executor.add_node(node)
            executor.spin()
    except (CmpTactileError, ParameterException) as error:
        return report_error(error)
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
    return leave_process(0)


def report_error(error: object) -> int:
    """Write what is wrong to stderr, mostly one line; returns the exit code, 1."""
    sys.stderr.write(f"error: {error_text(error)}\n")
    return 1


def leave_process(code: int) -> NoReturn:
    """End a process whose nodes are destroyed, without the interpreter's own end.

    That would wait for a constructor, callback or model that is still busy, and now and then it
    crashes in a thread of DDS (ros2/rclpy 178, eProsima/Fast-DDS 1906).
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


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
