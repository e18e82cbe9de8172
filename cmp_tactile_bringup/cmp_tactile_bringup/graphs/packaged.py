"""The packaged graphs `sensor`, `simulate`, `replay`, `gripper` and `grasp`."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, sin
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.graphs.description import (
    GRASP_STATE,
    GRIPPER_FRAME,
    WORLD_FRAME,
    Argument,
    Component,
    Graph,
    GraphFunction,
    Value,
    absolute_name,
    graph,
    load_graph_file,
)
from cmp_tactile_bringup.graphs.one_sensor import (
    CAMERA,
    REPLAY,
    SENSOR_ARGUMENTS,
    SIMULATED,
    TOPIC,
    pose,
    sensor_arguments,
    sensor_components,
)
from cmp_tactile_processing.cache.files import expanded_path
from cmp_tactile_processing.errors import InputError

# Height of the letters at two fingers, which are seen from farther away than one sensor, m.
FINGER_TEXT_M = 0.0009

FINGERS = tuple(f"{side}_finger" for side in ("left", "right"))

# What a gripper sets for both fingers, as its user does, or by itself.
OF_BOTH = ("rate", "start", "end", "loop", "paused", "record_topics", "record_compression")
OF_GRIPPER = ("namespace", "record", "publish_clock", *OF_BOTH)


def _one_sensor(given: Mapping[str, Any], **fixed: Any) -> list[Component]:
    nodes, source = sensor_components(given, **fixed)
    return [*nodes, *source]


@graph(*sensor_arguments((CAMERA, TOPIC)))
def sensor(given: Mapping[str, Any]) -> list[Component]:
    """A camera and the processing of its sensor."""
    return _one_sensor(given)


@graph(*sensor_arguments((SIMULATED,)))
def simulate(given: Mapping[str, Any]) -> list[Component]:
    """A simulated sensor instead of a camera, and its processing."""
    return _one_sensor(given, source=SIMULATED)


@graph(*sensor_arguments((REPLAY,)))
def replay(given: Mapping[str, Any]) -> list[Component]:
    """Plays a recording into the processing of one sensor."""
    return _one_sensor(given, source=REPLAY)


def _finger_arguments(side: str, y: float, turned: float) -> tuple[Argument, ...]:
    """The defaults are those of a finger of two that face one another along y."""
    return sensor_arguments(
        prefix=f"{side}_",
        without=OF_GRIPPER,
        name=f"{side}_finger",
        parent_frame="gripper",
        mount=f"0 {y} 0 {turned} 0 0",
    )


@graph(
    Argument("namespace", "namespace of both fingers; empty for none"),
    Argument(
        "record",
        "folder to record into, with a bag for each finger; it must not exist yet; empty: the "
        "recorders wait for their services",
    ),
    Argument("grasp_state", "compute how both fingers hold an object", default=True),
    *(item for item in SENSOR_ARGUMENTS if item.name in OF_BOTH),
    *_finger_arguments("left", 0.02, 1.5707963),
    *_finger_arguments("right", -0.02, -1.5707963),
)
def gripper(given: Mapping[str, Any]) -> list[Component]:
    """The sensors of a left and a right finger, each with its own source."""
    # Two clocks would contradict each other.
    left = _finger(given, "left_", publish_clock=True)
    right = _finger(given, "right_", publish_clock=given["left_source"] != REPLAY)
    both = [_grasp_state(given, left[0], right[0])] if given["grasp_state"] else []
    # The sources last, so that all is there when they begin.
    return [*left[0], *right[0], *both, *left[1], *right[1]]


def _grasp_state(given: Mapping[str, Any], *fingers: list[Component]) -> Component:
    """Of both fingers, in the frame that the left one is mounted on."""
    parameters: dict[str, Value] = {
        "use_sim_time": all(finger[0].parameters["use_sim_time"] for finger in fingers)
    }
    if given["left_parent_frame"]:
        parameters["frame"] = given["left_parent_frame"]
    topics = {
        f"{side}/force_field": f"{finger[0].namespace}/force_field"
        for side, finger in zip(("left", "right"), fingers, strict=True)
    }
    return Component(
        "cmp_tactile_processing",
        "cmp_tactile_processing::GraspStateEstimator",
        GRASP_STATE,
        absolute_name(given["namespace"]),
        topics,
        parameters,
    )


def _finger(
    given: Mapping[str, Any], prefix: str, *, publish_clock: bool
) -> tuple[list[Component], list[Component]]:
    fixed = {name: given[name] for name in OF_BOTH}
    if given["record"]:
        fixed["record"] = str(Path(given["record"], given[f"{prefix}name"]))
    look: dict[str, Value] = {}
    if given[f"{prefix}parent_frame"]:
        look = {"up": _up_of(given[f"{prefix}mount"]), "text_size": FINGER_TEXT_M}
    return sensor_components(
        given,
        prefix=prefix,
        below=given["namespace"],
        look=look,
        publish_clock=publish_clock,
        **fixed,
    )


def _up_of(mount: str) -> list[float]:
    """What is up in RViz, which shows both fingers in the frame they are mounted on.

    That frame's z in the gel frame, rounded: the angles of a mount have seven digits.
    """
    roll, pitch, _ = pose(mount)[3:]
    up = -sin(pitch), cos(pitch) * sin(roll), cos(pitch) * cos(roll)
    return [round(part, 6) for part in up]


@graph(
    Argument("scene", "grasp to simulate: packaged name or file (docs/grasp.md)", "box"),
    Argument(
        "drive",
        "what moves the fingers: the grip of the scene, or the opening on gripper/command",
        "scene",
        ("scene", "command"),
    ),
    Argument("loop", "play the scene's motion again and again", default=True),
)
def grasp(given: Mapping[str, Any]) -> list[Component]:
    """A gripper with two sensors holds an object in MuJoCo, and the processing of both sensors."""
    # Its rooms are imported by those who simulate alone.
    from cmp_tactile_simulation.grasp.scene import load_grasp

    fixed = {"source": TOPIC, "use_sim_time": True, "frame_queue": "newest"}
    files = load_grasp(given["scene"]).files.values()
    fingers = [
        sensor_components({**fixed, "sensor": str(file), "name": name})[0]
        for name, file in zip(FINGERS, files, strict=True)
    ]
    package = "cmp_tactile_simulation"
    parameters = {
        **given,
        "sensor_names": " ".join(FINGERS),
        GRIPPER_FRAME: "gripper",
        WORLD_FRAME: "world",
    }
    gripper = Component(
        package,
        f"{package}::GraspSimulator",
        "grasp_simulator",
        "/",
        parameters=parameters,
        process="/grasp",
    )
    state = _grasp_state({"left_parent_frame": "gripper", "namespace": ""}, *fingers)
    return [*fingers[0], *fingers[1], state, gripper]


GRAPHS = {item.function.__name__: item for item in (sensor, simulate, replay, gripper, grasp)}


def find_graph(name_or_path: str) -> GraphFunction:
    """A packaged graph by name, or that of a Python file by path.

    Raises InputError where there is neither, or the file cannot be used.
    """
    if name_or_path in GRAPHS:
        return GRAPHS[name_or_path]
    path = expanded_path(name_or_path)
    if not path.is_file():
        names = ", ".join(sorted(GRAPHS))
        msg = f"{name_or_path}: found no such file, expected a path or one of {names}"
        raise InputError(msg)
    return load_graph_file(path)


def load_graph(name_or_path: str, given: Mapping[str, Value] | None = None) -> Graph:
    """That graph with these arguments; raises InputError as `find_graph` and its `load` do."""
    return find_graph(name_or_path).load(given)
