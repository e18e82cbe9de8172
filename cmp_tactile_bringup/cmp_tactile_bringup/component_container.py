"""The executable `component_container`: loads Python components at the request of others.

Works with launch_ros's ComposableNodeContainer and with `ros2 component list/load/unload`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.signals import SignalHandlerOptions

from cmp_tactile_bringup.container import ComponentContainer
from cmp_tactile_bringup.container_services import ContainerServices
from cmp_tactile_bringup.stop_signal import StopSignal

__all__ = ["leave_process", "main", "running_container"]


@contextmanager
def running_container(
    args: Sequence[str], name: str = "component_container", namespace: str = ""
) -> Iterator[ComponentContainer]:
    """A container with its services, in the default ROS context, which is started for it.

    args: the process's arguments, whose ROS arguments may rename the container's node.
    At the end all components and the container's node are destroyed, then the context ends.
    """
    rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
    container = ComponentContainer()
    services = ContainerServices(container, name, namespace)
    try:
        yield container
    finally:
        container.shutdown()
        services.close()
        rclpy.try_shutdown()


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


def main() -> int:
    """Run the container until SIGINT or SIGTERM; returns 0."""
    stop = StopSignal()
    with running_container(sys.argv) as container:
        stop.wait()
    return leave_process(container, 0)


if __name__ == "__main__":
    sys.exit(main())
