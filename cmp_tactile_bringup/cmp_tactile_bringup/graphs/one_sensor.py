"""What may be set of one sensor, and the nodes of a graph that follow from it.

What is not set has the default of the node (docs/nodes.md) or of the sensor description.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

from cmp_tactile_bringup.graphs.description import (
    Argument,
    Component,
    GraphSensor,
    Value,
    absolute_name,
    as_text,
)
from cmp_tactile_bringup.recordings import library
from cmp_tactile_driver.sources.parameters import (
    CameraDriverParameters,
    CameraParameters,
    RecorderParameters,
    ReplayParameters,
)
from cmp_tactile_processing.cache.files import expanded_path, split_paths
from cmp_tactile_processing.errors import FrameSourceError, InputError
from cmp_tactile_processing.sensor.description import (
    find_sensor_description,
    load_sensor,
    packaged_sensors,
)

# Two underscores in a row stand for themselves in ROS's remapping rules.
ROS_NAME = r"(?!.*__)[A-Za-z_]\w*"
ROS_NAMESPACE = rf"(?!.*__)(/?{ROS_NAME}(/{ROS_NAME})*|/?)"
LETTERS = "letters, digits, single underscores"
SOURCES = SIMULATED, REPLAY, CAMERA, TOPIC = "simulated", "replay", "v4l2", "topic"
# Time after which markers vanish that are not drawn again, s; those of a replay stay while it is
# paused, or over.
MARKER_LIFETIME_S, REPLAYED_MARKER_LIFETIME_S = 2.0, 0.0


@dataclass(frozen=True)
class SensorArgument(Argument):
    """sources: with which it has an effect."""

    sources: tuple[str, ...] = SOURCES


def _of_node(
    parameters: Any, names: Sequence[str], *sources: str, prefix: str = ""
) -> Iterator[SensorArgument]:
    """Arguments with default, description and choices of parameters of a node."""
    for name in names:
        item = parameters.__dataclass_fields__[name]
        what, mark, rest = item.metadata["description"].partition(";")
        unit = f", {item.metadata['unit']}" if item.metadata["unit"] else ""
        description, choices = f"{what}{unit}{mark}{rest}", item.metadata["choices"]
        yield SensorArgument(prefix + name, description, item.default, choices, sources or SOURCES)


# Parameters of replay and camera that are arguments of a graph.
OF_REPLAY = ("topic", "rate", "start", "end", "loop", "paused", "publish_clock")
OF_CAMERA = ("device", "pixel_format", "colour")
SENSOR_ARGUMENTS = (
    SensorArgument(
        "source",
        "source of the frames: a simulated sensor, a recording, a camera, or another publisher on "
        "image_raw, such as `ros2 bag play`",
        SIMULATED,
        SOURCES,
    ),
    SensorArgument(
        "sensor",
        "sensor description, file or packaged name; a scene or recording may bring its own",
    ),
    SensorArgument(
        "name",
        "name of this sensor, the beginning of its tf frames; empty for the description's name",
    ),
    SensorArgument("namespace", "namespace of all nodes and topics; empty for the sensor's name"),
    SensorArgument(
        "frame_rate",
        "frames per second, Hz; 0: rate of the source, 30 for a folder of images",
        0.0,
        sources=(SIMULATED, REPLAY, CAMERA),
    ),
    SensorArgument(
        "input_transport",
        "topic of the frames: image_raw, or image_raw/compressed (PNG or JPEG)",
        "raw",
        ("raw", "compressed"),
        (TOPIC,),
    ),
    SensorArgument(
        "use_sim_time",
        "use the time of /clock, which `ros2 bag play --clock` publishes",
        default=False,
        sources=(TOPIC,),
    ),
    SensorArgument(
        "scene", "scene file, or name of a packaged scene", "grasp", sources=(SIMULATED,)
    ),
    SensorArgument(
        "autoplay",
        "repeat the scene's motion until a target or load comes",
        default=True,
        sources=(SIMULATED,),
    ),
    SensorArgument(
        "input",
        "bag, images, video, or name of a packaged scene; separate several by colons, they are "
        "played one after the other",
        "grasp",
        sources=(REPLAY,),
    ),
    *_of_node(ReplayParameters, OF_REPLAY, REPLAY),
    *_of_node(CameraParameters, OF_CAMERA, CAMERA),
    *_of_node(CameraDriverParameters, ("camera_info_url",), CAMERA),
    SensorArgument(
        "frame_queue",
        "frames to process if they come too quickly: every frame, or only the newest; auto: newest "
        "for a camera or simulation without record, else every",
        "auto",
        ("auto", "every", "newest"),
    ),
    SensorArgument("parent_frame", "tf frame on which the sensor is mounted; empty for none"),
    SensorArgument(
        "mount",
        'pose of the gel frame in parent_frame, "x y z roll pitch yaw" in m and rad',
        "0 0 0 0 0 0",
    ),
    SensorArgument(
        "record",
        "folder for a recorded bag, which must not exist; empty: a recorder waits for its service",
    ),
    *_of_node(RecorderParameters, ("topics", "compression"), prefix="record_"),
)
DEFAULTS = {item.name: item.default for item in SENSOR_ARGUMENTS}


def sensor_arguments(
    sources: Sequence[str] = SOURCES,
    *,
    prefix: str = "",
    without: Collection[str] = (),
    **defaults: bool | float | str,
) -> tuple[Argument, ...]:
    """The arguments of one sensor that a graph leaves to its user.

    sources: between which the user chooses; where it is one, the graph sets `source` itself.
    prefix: stands before all names.  without: names that the graph sets itself.  defaults: others
    than those of SENSOR_ARGUMENTS, by name without prefix.
    """
    found = []
    for item in SENSOR_ARGUMENTS:
        using = [source for source in sources if source in item.sources]
        if item.name in without or not using or (item.name == "source" and len(sources) == 1):
            continue
        changes: dict[str, Any] = {"name": prefix + item.name}
        if item.name == "source":
            changes |= {"default": sources[0], "choices": tuple(sources)}
        if len(using) < len(sources):
            only = f"; only with {prefix}source:={' or '.join(using)}"
            changes["description"] = item.description + only
        changes["default"] = defaults.get(item.name, changes.get("default", item.default))
        found.append(replace(item, **changes))
    return tuple(found)


def sensor_components(
    given: Mapping[str, Any],
    *,
    prefix: str = "",
    below: str = "",
    look: Mapping[str, Value] | None = None,
    **fixed: Any,
) -> tuple[list[Component], list[Component]]:
    """The nodes of one sensor, and the source of its frames, which is to be loaded last.

    given: values of arguments; those of the sensor begin with the prefix.  below: the namespace
    that the sensor's is relative to.  look: parameters of its markers.  fixed: arguments of the
    sensor that the graph sets itself.
    Raises InputError for settings that cannot be used.
    """
    own = {name: given[prefix + name] for name in DEFAULTS if prefix + name in given}
    settings: dict[str, Any] = {**DEFAULTS, **own, **fixed}
    source = settings["source"]
    for item in SENSOR_ARGUMENTS:
        if item.name in own and own[item.name] != item.default and source not in item.sources:
            found = f"found {as_text(own[item.name])}, which has no effect with {prefix}source"
            expected = f"expected {prefix}source:={' or '.join(item.sources)}"
            msg = f"argument {prefix}{item.name}: {found}:={source}, {expected}"
            raise InputError(msg)
    try:
        settings["mount"] = pose(settings["mount"])
        sensor = _find_sensor(settings, below)
    except (InputError, FrameSourceError) as error:
        msg = f"argument {prefix}{error}"
        raise InputError(msg) from None
    nodes = [*_processing(sensor, settings, look or {}), _recorder(sensor, settings)]
    return nodes, list(_source(sensor, settings))


def pose(text: str) -> list[float]:
    """The numbers of `mount`: x, y, z in m; roll, pitch, yaw in rad."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        expected = "six numbers, x y z in m and roll pitch yaw in rad"
        msg = f"mount: found {text!r}, expected {expected}"
        raise InputError(msg)
    return numbers


def _find_sensor(settings: Mapping[str, Any], below: str) -> GraphSensor:
    for name, expression, expected in (
        ("name", ROS_NAME, LETTERS),
        ("namespace", ROS_NAMESPACE, f"names of {LETTERS}, joined by /"),
    ):
        found = settings[name]
        if found and not re.fullmatch(expression, found, re.ASCII):
            msg = f"{name}: found {found!r}, expected {expected}"
            raise InputError(msg)
    given = settings["sensor"] or _sensor_of_source(settings)
    try:
        path = find_sensor_description(given).resolve()
        description = load_sensor(str(path))
    except InputError as error:
        msg = f"sensor: {error}"
        raise InputError(msg) from None
    name = settings["name"] or description.ros_name
    namespace = absolute_name(settings["namespace"] or name, below)
    views = tuple(view for view in ("left", "right") if view in description.views)
    return GraphSensor(name, namespace, path, views)


def _sensor_of_source(settings: Mapping[str, Any]) -> str:
    """The sensor description of what is to be played, where none is given."""
    if settings["source"] == SIMULATED:
        return library.sensor_of_scene(settings["scene"])
    inputs = split_paths(settings["input"]) if settings["source"] == REPLAY else []
    try:
        for item in inputs:
            library.check_source(item)
        sensor = library.sensor_of_recordings(inputs)
    except FrameSourceError as error:
        msg = f"input: {error}"
        raise InputError(msg) from None
    if not sensor:
        expected = f"the file of a description, or one of {', '.join(packaged_sensors())}"
        msg = f"sensor: found nothing, expected {expected}"
        raise InputError(msg)
    return sensor


def _component(
    sensor: GraphSensor, settings: Mapping[str, Any], plugin: str, name: str, **given: Value
) -> Component:
    """A component in the sensor's namespace that knows its description and name.

    It takes the time of /clock, which a replay publishes.
    """
    by_clock = settings["source"] == REPLAY or settings["use_sim_time"]
    own = {"sensor_description": str(sensor.description), "sensor_name": settings["name"]}
    parameters = {**own, "use_sim_time": by_clock, **given}
    package = plugin.partition("::")[0]
    return Component(package, plugin, name, sensor.namespace, {}, parameters, sensor=sensor)


def _processing(
    sensor: GraphSensor, settings: Mapping[str, Any], look: Mapping[str, Value]
) -> Iterator[Component]:
    """From camera frames to forces; from surfaces of a sensor without views."""

    def node(plugin: str, name: str, **given: Value) -> Component:
        return _component(sensor, settings, f"cmp_tactile_processing::{plugin}", name, **given)

    is_replay = settings["source"] == REPLAY
    lifetime = REPLAYED_MARKER_LIFETIME_S if is_replay else MARKER_LIFETIME_S
    queue = settings["frame_queue"]
    if queue == "auto":
        is_live = settings["source"] in (SIMULATED, CAMERA) and not settings["record"]
        queue = "newest" if is_live else "every"
    # Loaded only when the force model is built (once minutes, then cached on disk), so that a
    # recording does not begin without forces.
    yield node("ForceReconstructor", "force_reconstructor", wait_for_model=True)
    # After what a controller waits for.
    yield node("SurfaceVisualizer", "surface_visualizer", lifetime=lifetime, **look)
    if sensor.views:
        yield node("StereoTriangulator", "stereo_triangulator")
    for view in sensor.views:
        yield node("GridlineTracker", f"{view}_gridline_tracker", view=view)
    if not (sensor.views or settings["parent_frame"]):
        return
    mount = settings["mount"] if settings["parent_frame"] else [0.0] * 6
    # Its transforms mount a sensor without a camera, too.
    yield node(
        "ViewSplitter",
        "view_splitter",
        input_transport=settings["input_transport"],
        frame_queue=queue,
        parent_frame=settings["parent_frame"],
        mount_position=mount[:3],
        mount_orientation=mount[3:],
    )


def _recorder(sensor: GraphSensor, settings: Mapping[str, Any]) -> Component:
    """It records at once where a folder is given, else when its service is called."""
    folder = settings["record"]
    return _component(
        sensor,
        settings,
        "cmp_tactile_driver::Recorder",
        "recorder",
        output=str(expanded_path(folder).resolve()) if folder else "",
        autostart=bool(folder),
        topics=settings["record_topics"],
        compression=settings["record_compression"],
    )


def _records_frames(sensor: GraphSensor, settings: Mapping[str, Any]) -> bool:
    """Whether the recorder subscribes to the images."""
    topics = settings["record_topics"].split() if settings["record"] else []
    images = absolute_name("image_raw", sensor.namespace)
    return any(fnmatchcase(images, absolute_name(item, sensor.namespace)) for item in topics)


def _source(sensor: GraphSensor, settings: Mapping[str, Any]) -> Iterator[Component]:
    """What publishes the frames; nothing where others do."""
    source = settings["source"]
    if source == TOPIC:
        return
    names = {
        SIMULATED: ("source", "frame_rate", "autoplay"),
        CAMERA: ("source", "frame_rate", "camera_info_url", *OF_CAMERA),
        REPLAY: OF_REPLAY,
    }
    given: dict[str, Value] = {name: settings[name] for name in names[source]}
    if source == SIMULATED:
        given["input"] = _absolute(settings["scene"])
    if source != REPLAY:
        yield _component(
            sensor, settings, "cmp_tactile_driver::CameraDriver", "camera_driver", **given
        )
        return
    given["input"] = os.pathsep.join(_absolute(str(p)) for p in split_paths(settings["input"]))
    # The view splitter, and a recorder of its frames.
    given["wait_for_subscribers"] = 1 + _records_frames(sensor, settings)
    if settings["frame_rate"]:
        given["frame_rate"] = settings["frame_rate"]
    yield _component(sensor, settings, "cmp_tactile_driver::Replay", "replay", **given)


def _absolute(path: str) -> str:
    """A path for a container that was started elsewhere; the name of a packaged scene stays."""
    place = expanded_path(path)
    return str(place.resolve()) if place.exists() else path
