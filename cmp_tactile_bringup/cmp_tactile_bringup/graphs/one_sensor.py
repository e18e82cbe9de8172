"""What may be set of one sensor, and the nodes of a graph that follow from it.

What is not set has the default of the node (docs/nodes.md) or of the sensor description.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatchcase
from typing import Any

from cmp_tactile_bringup.errors import GraphError
from cmp_tactile_bringup.graphs.arguments import Argument, Condition, Value
from cmp_tactile_bringup.graphs.description import (
    LETTERS,
    ROS_NAME,
    ROS_NAMESPACE,
    Component,
    GraphSensor,
    absolute_name,
)
from cmp_tactile_bringup.recordings import library
from cmp_tactile_driver.bags.recording import split_inputs
from cmp_tactile_driver.sources.parameters import (
    CameraDriverParameters,
    CameraParameters,
    RecorderParameters,
    ReplayParameters,
)
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.description import (
    find_sensor_description,
    load_sensor,
    packaged_sensors,
)

SOURCES = ("simulated", "replay", "v4l2", "topic")
SIMULATED, REPLAY, CAMERA, TOPIC = (Condition("source", (name,)) for name in SOURCES)
SIMULATED_OR_CAMERA = Condition("source", ("simulated", "v4l2"))
RECORDING, MOUNTED = Condition("record"), Condition("parent_frame")
# Time after which markers vanish that are not drawn again, s; those of a replay stay while it is
# paused, or over.
MARKER_LIFETIME_S, REPLAYED_MARKER_LIFETIME_S = 2.0, 0.0
# Of the large-press correction in a frame, where the newest frame is wanted soon: 15 ms in all.
LIVE_PRESS_STEPS = 4
TYPE_OF = {str: "text", bool: "boolean", int: "integer", float: "number", tuple: "pose"}


def _setting(
    default: Any,
    description: str,
    only_with: Condition | None = None,
    *,
    kind: str = "",
    choices: tuple[str, ...] = (),
) -> Any:
    conditions = () if only_with is None else (only_with,)
    argument = Argument(
        "", kind or TYPE_OF[type(default)], description, default, choices, conditions
    )
    return field(default=default, metadata={"argument": argument})


def _parameter_of(node: Any, name: str, only_with: Condition) -> Any:
    """A setting with default, description and choices of a parameter of the node that takes it."""
    item = node.__dataclass_fields__[name]
    what, mark, rest = item.metadata["description"].partition(";")
    unit = f", {item.metadata['unit']}" if item.metadata["unit"] else ""
    description = f"{what}{unit}{mark}{rest}"
    return _setting(item.default, description, only_with, choices=item.metadata["choices"])


@dataclass(frozen=True)
class SensorSettings:
    """What may be set of one sensor; the arguments of the graphs are made from it."""

    source: str = _setting(
        "simulated",
        "source of the frames: a simulated sensor, a recording, a camera, or another "
        "publisher, such as `ros2 bag play`",
        choices=SOURCES,
    )
    sensor: str = _setting(
        "", "sensor description, file or packaged name; empty: that of the scene or recording"
    )
    name: str = _setting(
        "", "name of this sensor, the beginning of its tf frames; empty for the description's name"
    )
    namespace: str = _setting("", "namespace of all nodes and topics; empty for the sensor's name")
    frame_rate: float = _setting(
        0.0, "frames per second, Hz; 0: rate of the source", SIMULATED_OR_CAMERA
    )
    image_rate: float = _parameter_of(ReplayParameters, "frame_rate", REPLAY)
    input_transport: str = _setting(
        "raw",
        "topic of the frames: image_raw, or image_raw/compressed (PNG or JPEG)",
        TOPIC,
        choices=("raw", "compressed"),
    )
    use_sim_time: bool = _setting(
        False, "use the time of /clock, which `ros2 bag play --clock` publishes", TOPIC
    )
    scene: str = _setting(
        "grasp", "scene file, or name of a packaged scene", SIMULATED, kind="scene"
    )
    autoplay: bool = _setting(
        True, "repeat the scene's motion until a target or load comes", SIMULATED
    )
    max_speed: float = _setting(
        0.01, "highest speed of the indenter towards a target, m/s", SIMULATED
    )
    input: str = _setting(
        "grasp",
        "bag, images, video, or name of a packaged scene; separate several by colons, they "
        "are played one after the other",
        REPLAY,
        kind="recording",
    )
    topic: str = _parameter_of(ReplayParameters, "topic", REPLAY)
    rate: float = _parameter_of(ReplayParameters, "rate", REPLAY)
    start: float = _parameter_of(ReplayParameters, "start", REPLAY)
    end: float = _parameter_of(ReplayParameters, "end", REPLAY)
    loop: bool = _parameter_of(ReplayParameters, "loop", REPLAY)
    paused: bool = _parameter_of(ReplayParameters, "paused", REPLAY)
    wait_for_subscribers: int = _setting(
        1,
        "number of subscribers on image_raw before the first frame is sent: 1 for the view "
        "splitter, 1 more for a recorder",
        REPLAY,
    )
    publish_clock: bool = _parameter_of(ReplayParameters, "publish_clock", REPLAY)
    device: str = _parameter_of(CameraParameters, "device", CAMERA)
    pixel_format: str = _parameter_of(CameraParameters, "pixel_format", CAMERA)
    colour: bool = _parameter_of(CameraParameters, "colour", CAMERA)
    camera_info_url: str = _parameter_of(CameraDriverParameters, "camera_info_url", CAMERA)
    frame_queue: str = _setting(
        "auto",
        "frames to process if they come too quickly: every frame, or only the newest; auto: "
        "newest for a camera or simulation without record, else every",
        choices=("auto", "every", "newest"),
    )
    parent_frame: str = _setting("", "tf frame on which the sensor is mounted; empty for none")
    mount: tuple[float, ...] = _setting(
        (0.0,) * 6,
        'pose of the gel frame in parent_frame, "x y z roll pitch yaw" in m and rad',
        MOUNTED,
    )
    record: str = _setting(
        "",
        "folder for a recorded bag, which must not exist; empty for none",
        kind="path",
    )
    record_topics: str = _parameter_of(RecorderParameters, "topics", RECORDING)
    record_compression: str = _parameter_of(RecorderParameters, "compression", RECORDING)

    @classmethod
    def from_arguments(
        cls, given: Mapping[str, Any], prefix: str = "", **more: Any
    ) -> SensorSettings:
        """The settings among a graph's arguments, whose names begin with the prefix.

        more: settings that the graph makes itself.
        """
        names = {item.name: prefix + item.name for item in fields(cls)}
        found = {name: given[full] for name, full in names.items() if full in given}
        return cls(**{**found, **more})

    def some(self, *names: str) -> dict[str, Value]:
        """Settings by name, for a node that has parameters of these names."""
        return {name: getattr(self, name) for name in names}


def sensor_arguments(
    sources: Sequence[str] = SOURCES,
    *,
    prefix: str = "",
    without: Collection[str] = (),
    **defaults: Value,
) -> tuple[Argument, ...]:
    """The arguments of one sensor that a graph leaves to its user.

    sources: between which the user chooses; where it is one, the graph sets `source` itself.
    prefix: stands before all names.  without: names that the graph sets itself.  defaults: others
    than those of SensorSettings, by name without prefix.
    """
    left_out = {*without, "source"} if len(sources) == 1 else {*without}
    found = []
    for item in fields(SensorSettings):
        argument: Argument = item.metadata["argument"]
        having_effect = tuple(name for name in sources if _has_effect(argument, name))
        if item.name in left_out or not having_effect:
            continue
        if item.name == "source":
            argument = replace(argument, default=sources[0], choices=tuple(sources))
        conditions = (
            Condition(prefix + some.argument, having_effect if _on_source(some) else some.values)
            for some in argument.only_with
            if not (_on_source(some) and len(having_effect) == len(sources))
        )
        default = defaults.get(item.name, argument.default)
        name = prefix + item.name
        found.append(replace(argument, name=name, default=default, only_with=tuple(conditions)))
    return tuple(found)


def _on_source(condition: Condition) -> bool:
    return condition.argument == "source"


def _has_effect(argument: Argument, source: str) -> bool:
    return all(item.holds(source) for item in argument.only_with if _on_source(item))


def sensor_components(
    settings: SensorSettings,
    *,
    prefix: str = "",
    below: str = "",
    look: Mapping[str, Value] | None = None,
) -> tuple[list[Component], list[Component]]:
    """The nodes of one sensor, and the source of its frames, which is to be loaded last.

    prefix: of its arguments in errors.  below: the namespace that the sensor's is relative to.
    look: parameters of its markers, where they are not the default.
    Raises GraphError for settings that cannot be used.
    """
    sensor = _find_sensor(settings, prefix, below)
    nodes = [*_processing(sensor, settings, look or {}), *_recorder(sensor, settings)]
    return nodes, list(_source(sensor, settings))


def _find_sensor(settings: SensorSettings, prefix: str, below: str) -> GraphSensor:
    try:
        path = find_sensor_description(settings.sensor or _sensor_of_source(settings, prefix))
        description = load_sensor(str(path.resolve()))
    except DescriptionError as error:
        msg = f"argument {prefix}sensor: {error}"
        raise GraphError(msg) from None
    for name, expression, expected in (
        ("name", ROS_NAME, LETTERS),
        ("namespace", ROS_NAMESPACE, f"names of {LETTERS}, joined by /"),
    ):
        found = getattr(settings, name)
        if found and not expression.fullmatch(found):
            msg = f"argument {prefix}{name}: found {found!r}, expected {expected}"
            raise GraphError(msg)
    own_name = settings.name
    namespace = absolute_name(settings.namespace or own_name or description.ros_name, below)
    views = tuple(view for view in ("left", "right") if view in description.views)
    return GraphSensor(own_name, description.ros_name, namespace, path.resolve(), views)


def _sensor_of_source(settings: SensorSettings, prefix: str) -> str:
    """The sensor description of what is to be played, where none is given."""
    if settings.source == "simulated":
        return library.sensor_of_scene(settings.scene)
    inputs = split_inputs(settings.input) if settings.source == "replay" else []
    try:
        for item in inputs:
            library.check_source(item)
    except library.RecordingError as error:
        msg = f"argument {prefix}input: {error}"
        raise GraphError(msg) from None
    sensor = library.sensor_of_recordings(inputs)
    if not sensor:
        expected = f"the file of a description, or one of {', '.join(packaged_sensors())}"
        msg = f"argument {prefix}sensor: found nothing, expected {expected}"
        raise GraphError(msg)
    return sensor


def _by_clock(settings: SensorSettings) -> dict[str, Value]:
    """Whose time the nodes take: a replay publishes /clock."""
    return {"use_sim_time": settings.source == "replay" or settings.use_sim_time}


def _processing(
    sensor: GraphSensor, settings: SensorSettings, look: Mapping[str, Value]
) -> Iterator[Component]:
    """From camera frames to forces; from surfaces of a sensor without views."""

    def node(plugin: str, name: str, **parameters: Value) -> Component:
        given = _by_clock(settings) | parameters
        return sensor.component(f"cmp_tactile_processing::{plugin}", name, given)

    is_replay = settings.source == "replay"
    lifetime = REPLAYED_MARKER_LIFETIME_S if is_replay else MARKER_LIFETIME_S
    # Loaded only when the force model is built (once minutes, then cached on disk), so that a
    # recording does not begin without forces.
    newest = _frame_queue(settings) == "newest"
    steps = {"large_press_steps": LIVE_PRESS_STEPS} if newest else {}
    yield node("ForceReconstructor", "force_reconstructor", wait_for_model=True, **steps)
    # After what a controller waits for.
    yield node("SurfaceVisualizer", "surface_visualizer", lifetime=lifetime, **look)
    if sensor.views:
        yield node("StereoTriangulator", "stereo_triangulator")
    for view in sensor.views:
        yield node("GridlineTracker", f"{view}_gridline_tracker", view=view)
    if not (sensor.views or settings.parent_frame):
        return
    mount = list(settings.mount if settings.parent_frame else (0.0,) * 6)
    # Its transforms mount a sensor without a camera, too.
    yield node(
        "ViewSplitter",
        "view_splitter",
        input_transport=settings.input_transport,
        frame_queue=_frame_queue(settings),
        parent_frame=settings.parent_frame,
        mount_position=mount[:3],
        mount_orientation=mount[3:],
    )


def _frame_queue(settings: SensorSettings) -> str:
    if settings.frame_queue != "auto":
        return settings.frame_queue
    live = settings.source in ("v4l2", "simulated") and not settings.record
    return "newest" if live else "every"


def _recorder(sensor: GraphSensor, settings: SensorSettings) -> Iterator[Component]:
    if settings.record:
        parameters = {
            "output": settings.record,
            "topics": settings.record_topics,
            "compression": settings.record_compression,
            **_by_clock(settings),
        }
        yield sensor.component("cmp_tactile_driver::Recorder", "recorder", parameters)


def _records_frames(sensor: GraphSensor, settings: SensorSettings) -> bool:
    """Whether the recorder subscribes to the images."""
    topics = settings.record_topics.split() if settings.record else []
    images = absolute_name("image_raw", sensor.namespace)
    return any(fnmatchcase(images, absolute_name(item, sensor.namespace)) for item in topics)


def _source(sensor: GraphSensor, settings: SensorSettings) -> Iterator[Component]:
    """What publishes the frames; nothing where others do."""
    camera = "cmp_tactile_driver::CameraDriver", "camera_driver"
    if settings.source == "simulated":
        given = settings.some("source", "frame_rate", "autoplay", "max_speed")
        yield sensor.component(*camera, {**given, "input": settings.scene})
    elif settings.source == "v4l2":
        given = settings.some(
            "source", "device", "frame_rate", "pixel_format", "colour", "camera_info_url"
        )
        yield sensor.component(*camera, given)
    elif settings.source == "replay":
        given = settings.some("input", "topic", "rate", "start", "end", "loop", "paused")
        given |= settings.some("publish_clock")
        awaited = settings.wait_for_subscribers + _records_frames(sensor, settings)
        given["wait_for_subscribers"] = awaited
        # Its diagnostics have the time of /clock, as those of the other nodes.
        given |= {"frame_rate": settings.image_rate, "use_sim_time": True}
        yield sensor.component("cmp_tactile_driver::Replay", "replay", given)
