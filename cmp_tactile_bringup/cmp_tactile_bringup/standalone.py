"""The executable `standalone`: a graph file in one container, for machines without launch.

ros2 run cmp_tactile_bringup standalone replay input:=bag rate:=0.5 --set replay.loop=true
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cmp_tactile_bringup.stop_signal import StopSignal

__all__ = ["main"]


def main(args: Sequence[str] | None = None) -> int:
    """Run a graph until SIGINT or SIGTERM; the exit code, 0 after a clean end."""
    # Before what takes a second to import: a signal is to end that in order, too.
    stop = StopSignal()
    from cmp_tactile_bringup.graph_runner import run_graph

    if stop.by_signal:
        return 0
    return run_graph(list(sys.argv if args is None else ["standalone", *args]), stop)


if __name__ == "__main__":
    sys.exit(main())
