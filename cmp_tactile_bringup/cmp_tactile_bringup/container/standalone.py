"""The executable `standalone`: a graph file in one container, for machines without launch.

ros2 run cmp_tactile_bringup standalone replay input:=bag rate:=0.5 --set replay.loop=true
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import nullcontext

from cmp_tactile_bringup.terminal.stop_signal import StopSignal

__all__ = ["main"]


def main(args: Sequence[str] | None = None, *, local: bool = True) -> int:
    """Run a graph until SIGINT or SIGTERM; the exit code, 0 after a clean end.

    local: keep away from the network, unless the user chose something else.
    """
    # Before what takes a second to import: a signal is to end that in order, too.
    stop = StopSignal()
    from cmp_tactile_bringup.container.graph_runner import run_graph
    from cmp_tactile_bringup.graphs.loopback import on_loopback

    if stop.by_signal:
        return 0
    with on_loopback() if local else nullcontext():
        return run_graph(list(sys.argv if args is None else ["standalone", *args]), stop)


if __name__ == "__main__":
    sys.exit(main())
