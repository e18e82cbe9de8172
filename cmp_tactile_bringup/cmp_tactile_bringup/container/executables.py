"""The executables `component_container` and `standalone`.

`python3 -m cmp_tactile_bringup.container.executables standalone replay input:=bag rate:=0.5`
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress

from cmp_tactile_bringup.terminal.stop_signal import StopSignal

M_ARENA_MAX = -8
"""Of mallopt in glibc: how many heaps threads may have."""


def component_container() -> int:
    """Load Python components at the request of others until SIGINT or SIGTERM; the exit code.

    Works with launch_ros's ComposableNodeContainer and with `ros2 component list/load/unload`.
    """
    # Before what takes a second to import: a signal is to end that in order, too.
    stop = StopSignal()
    _prepare_for_threads()
    from cmp_tactile_bringup.container.services import running_container
    from cmp_tactile_processing.errors import printable
    from cmp_tactile_processing.ros.process import JoinError, leave_process

    if stop.by_signal:
        return 0
    try:
        with running_container(sys.argv) as container:
            # A component may end the ROS context, without which nothing runs.
            container.context.on_shutdown(stop.set)
            stop.wait()
    except JoinError as error:
        sys.stderr.write(printable(f"error: {error}") + "\n")
        return 1
    return leave_process(0, container.threads_before)


def standalone(args: Sequence[str] | None = None, *, local: bool = True) -> int:
    """Run a graph until SIGINT or SIGTERM, without launch; the exit code.

    local: keep away from the network, unless the user chose something else.
    """
    stop = StopSignal()
    _prepare_for_threads()
    from cmp_tactile_bringup.container.graph_runner import run_graph
    from cmp_tactile_bringup.container.loopback import on_loopback

    if stop.by_signal:
        return 0
    with on_loopback() if local else nullcontext():
        return run_graph(list(sys.argv if args is None else ["standalone", *args]), stop)


def given_graph() -> int:
    """Run the graph on stdin: what `standalone` starts for each sensor but the first."""
    stop = StopSignal()
    _prepare_for_threads()
    from cmp_tactile_bringup.container.graph_runner import run_given_graph

    return run_given_graph(sys.argv, stop)


def _prepare_for_threads() -> None:
    """Make the most of one core for each component, before OpenCV and NumPy are imported."""
    # OpenCV's own threads wait for work by spinning: 3 of 22 ms of processor time a frame.
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    with suppress(AttributeError, OSError):  # another C library
        # Keep all threads on one heap: glibc's heap for each thread costs a container 50 MB.
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


if __name__ == "__main__":
    _EXECUTABLES = (component_container, standalone, given_graph)
    sys.exit({item.__name__: item for item in _EXECUTABLES}[sys.argv.pop(1)]())
