"""A component container with its services, as long as a process wants it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_bringup.container import ComponentContainer
from cmp_tactile_bringup.container_services import ContainerServices

__all__ = ["leave_process", "running_container"]

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
    """
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
    container = ComponentContainer()
    services = ContainerServices(container, name, namespace)
    try:
        yield container
    finally:
        container.shutdown()
        services.close()
        rclpy.try_shutdown()
        sys.setswitchinterval(interval)


def leave_process(container: ComponentContainer, code: int) -> int:
    """The exit code, once nothing of the container runs any more.

    A constructor or callback that is still busy would keep the interpreter from ending, or crash
    it; the process is then left without the interpreter's clean-up.
    """
    if container.left_behind:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code
