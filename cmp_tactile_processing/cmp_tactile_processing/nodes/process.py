"""Runs one node as a process."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from cmp_tactile_processing.errors import CmpTactileError

__all__ = ["run_node"]


def run_node(make_node: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT, SIGTERM or shutdown; the exit code.  For the main thread.

    0 after a clean end; 1, with one line on stderr, where the node cannot start as it is set up.
    """
    node = None
    # rclpy passes SIGTERM on to this handler: it ends a constructor that compiles for a minute.
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        rclpy.init(args=args)
        node = make_node()
        rclpy.spin(node)
    except (CmpTactileError, ParameterException) as error:
        sys.stderr.write(f"error: {error}\n")
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
        signal.signal(signal.SIGTERM, before)
    return 0
