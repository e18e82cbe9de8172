"""Settings of RViz for the sensors of a graph, from the packaged ones."""

from __future__ import annotations

import atexit
import re
import tempfile
from pathlib import Path

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.description import Graph
from cmp_tactile_bringup.graphs.shared_files import share_folder

__all__ = ["SETTINGS", "rviz_settings", "write_rviz_settings"]

# Files by the number of sensors, with the names in whose place the graph's are put: the packaged
# settings can be opened as they are, but RViz takes absolute topics only.
SETTINGS = {
    1: ("cmp_tactile.rviz", ("sample_rig",)),
    2: ("gripper.rviz", ("left_finger", "right_finger")),
}
# The tf frame that gripper.rviz shows them in.
PARENT_FRAME = "gripper"


def rviz_settings(graph: Graph) -> str:
    """The text of a settings file with the namespaces and frames of the graph's sensors.

    Raises GraphError where there are none for so many sensors.
    """
    number = len(graph.sensors)
    if number not in SETTINGS:
        msg = f"{graph.path}: rviz: found {number} sensors, expected 1 or 2"
        raise GraphError(msg)
    file, names = SETTINGS[number]
    text = (share_folder() / "rviz" / file).read_text(encoding="utf-8")
    places = {}
    for name, sensor in zip(names, graph.sensors, strict=True):
        places[f"/{name}/"] = f"{sensor.namespace}/"
        places[f"{name}_"] = f"{sensor.name}_"
    # At once, so that nothing is put in the place of what was put there.
    either = "|".join(rf"(?<!\w){re.escape(place)}" for place in places)
    text = re.sub(either, lambda match: places[match[0]], text)
    parent = _parent_frame(graph)
    return re.sub(rf"(Frame: ){PARENT_FRAME}$", rf"\g<1>{parent}", text, flags=re.MULTILINE)


def write_rviz_settings(graph: Graph) -> Path:
    """A file with the settings, until this process ends; GraphError where there are none."""
    text = rviz_settings(graph)
    with tempfile.NamedTemporaryFile(
        "w", prefix="cmp_tactile_", suffix=".rviz", delete=False, encoding="utf-8"
    ) as file:
        file.write(text)
    path = Path(file.name)
    atexit.register(path.unlink, missing_ok=True)
    return path


def _parent_frame(graph: Graph) -> str:
    """What the first sensor is mounted on; its gel frame where it is on nothing."""
    sensor = graph.sensors[0]
    for component in graph.components:
        if component.namespace == sensor.namespace and component.parameters.get("parent_frame"):
            return str(component.parameters["parent_frame"])
    return f"{sensor.name}_gel_frame"
