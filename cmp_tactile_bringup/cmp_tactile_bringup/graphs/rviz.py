"""The settings with which RViz shows the sensors of a graph."""

from __future__ import annotations

import re
from pathlib import Path

from cmp_tactile_bringup.graphs.description import GRASP_STATE, GRIPPER_FRAME, Graph
from cmp_tactile_processing.cache.files import (
    atomic_path,
    config_dir,
    folder_without_home,
    packaged_files,
)
from cmp_tactile_processing.errors import InputError

PACKAGE = "cmp_tactile_bringup"

# Files by the number of sensors, with the names in whose place the graph's are put: the packaged
# settings can be opened as they are, but RViz takes absolute topics only.
RVIZ_SETTINGS = {
    1: ("cmp_tactile", ("sample_rig",)),
    2: ("gripper", ("left_finger", "right_finger")),
}
# The tf frame that gripper.rviz shows them in.
PARENT_FRAME = "gripper"


def rviz_settings(graph: Graph) -> str:
    """The text of a settings file with the namespaces and frames of the graph's sensors.

    Raises InputError where there are none for so many sensors.
    """
    number = len(graph.sensors)
    if number not in RVIZ_SETTINGS:
        msg = f"rviz: found {number} sensors, expected 1 or 2"
        raise InputError(msg)
    file, names = RVIZ_SETTINGS[number]
    text = packaged_files(PACKAGE, "rviz/*.rviz")[file].read_text(encoding="utf-8")
    places = {}
    for name, sensor in zip(names, graph.sensors, strict=True):
        places[f"/{name}/"] = f"{sensor.namespace}/"
        places[f"{name}_"] = f"{sensor.name}_"
    for item in graph.components:
        if item.name == GRASP_STATE:
            places["/grasp_markers"] = f"{item.namespace.rstrip('/')}/grasp_markers"
    # At once, so that nothing is put in the place of what was put there.
    either = "|".join(rf"(?<!\w){re.escape(place)}" for place in places)
    text = re.sub(either, lambda match: places[match[0]], text)
    return text.replace(f"Frame: {PARENT_FRAME}\n", f"Frame: {_fixed_frame(graph)}\n")


def _fixed_frame(graph: Graph) -> str:
    """What two sensors are mounted on, or a gripper gives; else the first one's gel frame."""
    if found := graph.first_of(GRIPPER_FRAME):
        return found
    first = graph.sensors[0]
    mounts = (
        item.parameters.get("parent_frame") for item in graph.components if item.sensor is first
    )
    parent = next(filter(None, mounts), "") if len(graph.sensors) > 1 else ""
    return parent or f"{first.name}_gel_frame"


def rviz_settings_file(graph: Graph) -> Path:
    """The file with these settings, one for the graph's sensors, in the user's configuration.

    RViz asks to save into it what was changed, a view that was turned included, and what was saved
    is kept.  Raises InputError where there are no settings, or no place for them.
    """
    text = rviz_settings(graph)
    words = [item.namespace.strip("/") for item in graph.sensors]
    words += [item.name for item in graph.sensors]
    words.append(_fixed_frame(graph))
    name = "-".join(re.sub(r"\W", "_", word) for word in dict.fromkeys(words))
    failed = ""
    for folder in (config_dir(), folder_without_home()):
        path = folder / "rviz" / f"{name}.rviz"
        try:
            if not is_saved_by_rviz(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                with atomic_path(path) as part:
                    part.write_text(text, encoding="utf-8")
        except OSError as error:
            failed = f"{path}: {error.strerror}"
        else:
            return path
    msg = f"rviz: the settings cannot be written: {failed}"
    raise InputError(msg)


def is_saved_by_rviz(path: Path) -> bool:
    """Whether somebody saved there from RViz, which writes no comments; ours begin with one."""
    try:
        with path.open("rb") as file:
            return file.read(1) not in (b"#", b"")
    except FileNotFoundError:
        return False
