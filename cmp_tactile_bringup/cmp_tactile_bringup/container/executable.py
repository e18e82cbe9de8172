"""The executable `component_container`: loads Python components at the request of others.

Works with launch_ros's ComposableNodeContainer and with `ros2 component list/load/unload`.
"""

from __future__ import annotations

import sys

from cmp_tactile_bringup.terminal.stop_signal import StopSignal

__all__ = ["main"]


def main() -> int:
    """Run the container until SIGINT or SIGTERM; the exit code, 0 after a clean end."""
    # Before what takes a second to import: a signal is to end that in order, too.
    stop = StopSignal()
    from cmp_tactile_bringup.container.running import leave_process, running_container
    from cmp_tactile_processing.errors import printable
    from cmp_tactile_processing.ros.process import SecurityError

    if stop.by_signal:
        return 0
    try:
        with running_container(sys.argv) as container:
            # A component may end the ROS context, without which nothing runs.
            container.context.on_shutdown(stop.set)
            stop.wait()
    except SecurityError as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    return leave_process(container, 0)


if __name__ == "__main__":
    sys.exit(main())
