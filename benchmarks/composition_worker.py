"""The container that `composition.py` measures: sensors in one process, with or without DDS."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from cmp_tactile_bringup.container.component_description import ComponentDescription
from cmp_tactile_bringup.container.running import leave_process, running_container
from cmp_tactile_bringup.graphs.description import load_graph
from cmp_tactile_bringup.terminal.stop_signal import StopSignal

GRAPH = Path(__file__).parent / "graphs" / "played.yaml"


def main() -> int:
    """Run until SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dds", action="store_true", help="hand nothing over")
    parser.add_argument("--names", nargs="+", help="a sensor of each name")
    parser.add_argument("arguments", nargs="+", metavar="NAME:=VALUE")
    options = parser.parse_args()
    given = dict(item.split(":=", 1) for item in options.arguments)
    stop = StopSignal()
    with running_container([sys.argv[0]], "tactile_container") as container:
        graphs = [load_graph(GRAPH, {**given, "name": name}) for name in options.names]
        # All sensors are there before the first camera begins.
        for last in (False, True):
            for graph in graphs:
                for component in graph.components:
                    if (component.name == "camera_driver") is last:
                        description = ComponentDescription.from_graph(component)
                        container.load(replace(description, intra_process=not options.dds))
        stop.wait()
    return leave_process(container, 0)


if __name__ == "__main__":
    sys.exit(main())
