"""The graph of the benchmarks in this folder: a recording replaces the camera of each sensor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cmp_tactile_bringup.graphs.description import Argument, Component, graph
from cmp_tactile_bringup.graphs.one_sensor import sensor_components


@graph(
    Argument("input", "bag to play"),
    Argument("sensor", "sensor description, file or name of a packaged one"),
    Argument("names", "names of the sensors, separated by spaces"),
    Argument("frame_rate", "frames per second of each, Hz", 30.0),
    Argument("frame_queue", "as that of the packaged graphs", "newest"),
)
def cameras(given: Mapping[str, Any]) -> list[Component]:
    """Sensors with the frames of a recording, at a chosen rate, again and again.

    They are stamped when they are published.
    """
    found, last = [], []
    for name in given["names"].split():
        own = {key: given[key] for key in ("sensor", "frame_queue")}
        nodes, _ = sensor_components(own, source="topic", name=name)
        found += nodes
        sensor = {k: nodes[0].parameters[k] for k in ("sensor_description", "sensor_name")}
        source = {"source": "bag", "input": given["input"], "frame_rate": given["frame_rate"]}
        package = "cmp_tactile_driver"
        camera = Component(
            package,
            f"{package}::CameraDriver",
            "camera_driver",
            nodes[0].namespace,
            parameters={**sensor, **source, "loop": True},
            sensor=nodes[0].sensor,
        )
        last.append(camera)
    return [*found, *last]
