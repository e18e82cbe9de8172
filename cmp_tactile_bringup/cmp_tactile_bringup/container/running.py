"""A component container with its services, as long as a process wants it."""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.container.services import ContainerServices
from cmp_tactile_processing.ros.diagnostics.graph_watch import DISCOVERY_S
from cmp_tactile_processing.ros.process import SecurityError, joining_ros

__all__ = ["leave_process", "running_container"]

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
    Raises SecurityError where ROS cannot be joined as securely as the user asks.
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        with joining_ros():
            rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
            container = ComponentContainer()
            services = ContainerServices(container, name, namespace, DISCOVERY_S)
    except SecurityError:
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


def leave_process(container: ComponentContainer, code: int) -> int:
    """The exit code, once nothing of the container runs any more.

    A constructor or callback that is still busy, or a model that is still being built, would keep
    the interpreter from ending, or crash it; the process is then left without the interpreter's
    clean-up.
    """
    if container.has_threads:
        _leave_at_once(code)
    return code


def _leave_stuck() -> None:
    sys.stderr.write(f"the end took more than {END_TIMEOUT:g} s; what still runs:\n")
    faulthandler.dump_traceback(file=sys.stderr)
    _leave_at_once(0)


def _leave_at_once(code: int) -> None:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
