"""The container that `composition.py` measures: sensors in one process, with or without DDS."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from cmp_tactile_bringup.container.services import leave_process, running_container
from cmp_tactile_bringup.graphs.description import Argument, Component, Graph, graph
from cmp_tactile_bringup.graphs.packaged import SensorSettings, sensor_components
from cmp_tactile_bringup.terminal.stop_signal import StopSignal


@graph(
    Argument("input", "path", "bag to play"),
    Argument("sensor", "text", "sensor description, file or name of a packaged one"),
    Argument("name", "text", "name of the sensor; empty for the description's", ""),
    Argument("frame_rate", "number", "frames per second, Hz"),
)
def played(given: Mapping[str, Any]) -> list[Component]:
    """A recording in place of a camera: its frames come at a chosen rate, again and again.

    They are stamped when they are published.
    """
    nodes, _ = sensor_components(SensorSettings.from_arguments(given, source="topic"))
    (sensor,) = Graph(tuple(nodes), "").sensors
    given = {"source": "bag", "input": given["input"], "frame_rate": given["frame_rate"]}
    camera = "cmp_tactile_driver::CameraDriver", "camera_driver"
    return [*nodes, sensor.component(*camera, {**given, "loop": True})]


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
        graphs = [played.load({**given, "name": name}) for name in options.names]
        # All sensors are there before the first camera begins.
        for last in (False, True):
            for graph in graphs:
                for component in graph.components:
                    if (component.name == "camera_driver") is last:
                        container.load(replace(component, intra_process=not options.dds))
        stop.wait()
    return leave_process(container, 0)


if __name__ == "__main__":
    sys.exit(main())
