"""The executables `component_container` and `standalone`.

`python3 -m cmp_tactile_bringup.container.executables standalone replay input:=bag rate:=0.5`
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import suppress

from cmp_tactile_processing.processes import StopSignal

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
    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_processing.ros.process import leave_process, report_error

    if stop.by_signal:
        return 0
    try:
        with running_container(sys.argv) as container:
            # A component may end the ROS context, without which nothing runs.
            container.context.on_shutdown(stop.set)
            stop.wait()
    except CmpTactileError as error:
        return report_error(error)
    return leave_process(0)


def standalone(args: Sequence[str] | None = None) -> int:
    """Run a graph until SIGINT or SIGTERM, without launch; the exit code."""
    stop = StopSignal()
    _prepare_for_threads()
    from cmp_tactile_bringup.container.graph_runner import run_graph

    if stop.by_signal:
        return 0
    return run_graph(list(sys.argv if args is None else ["standalone", *args]), stop)


def _prepare_for_threads() -> None:
    """Make the most of one core for each component, before OpenCV and NumPy are imported."""
    # OpenCV's own threads wait for work by spinning: 3 of 22 ms of processor time a frame.
    os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")
    with suppress(AttributeError, OSError):  # another C library
        # Keep all threads on one heap: glibc's heap for each thread costs a container 50 MB.
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


if __name__ == "__main__":
    _EXECUTABLES = (component_container, standalone)
    sys.exit({item.__name__: item for item in _EXECUTABLES}[sys.argv.pop(1)]())
