"""Runs one node as a process."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from cmp_tactile_processing.errors import CmpTactileError, printable

__all__ = ["run_node"]

REPEAT_S = 0.5


def run_node(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT, SIGTERM or shutdown; the exit code.  For the main thread.

    0 after a clean end; 1, with one line on stderr, where the node cannot start as it is set up.
    """
    node = None
    before = frozenset(threading.enumerate())
    try:
        with _interruptible():
            rclpy.init(args=args)
            node = make_node()
            rclpy.spin(node)
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
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    if frozenset(threading.enumerate()) - before:
        # Such as a model that is still being built: it would crash the interpreter as that ends.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGINT and SIGTERM raise KeyboardInterrupt in here, also in a constructor that compiles.

    Python drops an exception that is raised within a finaliser, and a compiler runs many of them:
    the interrupt is repeated until it comes through, and no traceback tells of the lost ones.
    rclpy passes its signals on to these handlers.
    """
    tell_unraisable = sys.unraisablehook

    def tell(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            tell_unraisable(unraisable)

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, REPEAT_S)
        raise KeyboardInterrupt

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = {number: signal.signal(number, interrupt) for number in numbers}
    sys.unraisablehook = tell
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = tell_unraisable
