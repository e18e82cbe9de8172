"""The graph of the benchmarks in this folder: a recording replaces the camera of each sensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cmp_tactile_bringup.graphs.description import Argument, Component, Graph, graph
from cmp_tactile_bringup.graphs.one_sensor import SensorSettings, sensor_components


@graph(
    Argument("input", "path", "bag to play"),
    Argument("sensor", "text", "sensor description, file or name of a packaged one"),
    Argument("names", "text", "names of the sensors, separated by spaces"),
    Argument("frame_rate", "number", "frames per second of each, Hz"),
    Argument("frame_queue", "text", "as that of the packaged graphs", "newest"),
)
def cameras(given: Mapping[str, Any]) -> list[Component]:
    """Sensors with the frames of a recording, at a chosen rate, again and again.

    They are stamped when they are published.
    """
    found, last = [], []
    for name in given["names"].split():
        settings = SensorSettings.from_arguments(given, source="topic", name=name)
        nodes, _ = sensor_components(settings)
        (sensor,) = Graph(tuple(nodes), "").sensors
        source = {"source": "bag", "input": given["input"], "frame_rate": given["frame_rate"]}
        camera = "cmp_tactile_driver::CameraDriver", "camera_driver"
        found += nodes
        last.append(sensor.component(*camera, {**source, "loop": True}))
    return [*found, *last]
