"""`cmp_tactile zero`, `call`, `topics`, `echo`, `record`: use nodes that run, without `ros2`."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cmp_tactile_bringup.commands.options import Command, Number, argument, option, parameter_option
from cmp_tactile_driver.sources.parameters import MEGABYTE, RecorderParameters
from cmp_tactile_processing.errors import CmpTactileError

if TYPE_CHECKING:
    from rclpy.node import Node

    from cmp_tactile_driver.bags.writer import RecordingProgress

SPLITTER = "view_splitter"
SEARCH_TIME_S = 5.0
# In which a force comes from a sensor that runs; one without is zeroed all the same.
FORCE_S = 3.0
MOST_VALUES = 12
OF_ALL_NODES = "/parameter_events", "/rosout"
WAIT_S = 0.5
# Nodes are discovered one after the other; on a busy machine a second may pass between two.
ALL_TOPICS_S = 2.0
PERIOD_S = 0.2
# Options that are parameters of the node.
SAME_NAMES = ("output", "compression", "jpeg_quality")
_setting = partial(parameter_option, RecorderParameters)


@dataclass(frozen=True)
class RunningSensor:
    """A sensor's namespace, and the parameters of its nodes; empty where they do not answer."""

    namespace: str
    description: str = ""
    name: str = ""


def find_sensor(node: Node, namespace: str = "") -> RunningSensor:
    """The sensor of a namespace, or of one of its topics, or the only one that runs.

    node: with which it is looked for; it is spun by another thread.  Waits some seconds.  Raises
    CmpTactileError where there is none, or several.
    """
    from cmp_tactile_processing.ros.services import settled

    wanted = f"/{namespace.strip('/')}" if namespace else ""
    spaces = settled(lambda: _namespaces(node, wanted), SEARCH_TIME_S)
    if not spaces:
        there = ", ".join(_namespaces(node, "")) or "one; is ROS_DOMAIN_ID the same?"
        msg = f"found no running sensor{f' in {wanted}' if wanted else ''}, expected {there}"
        raise CmpTactileError(msg)
    if len(spaces) > 1:
        msg = f"found several sensors, expected the namespace of one of: {', '.join(spaces)}"
        raise CmpTactileError(msg)
    return _described(node, spaces[0])


def _namespaces(node: Node, wanted: str) -> list[str]:
    """Those of all sensors, or that in which what is wanted lies."""
    found = {space for name, space in node.get_node_names_and_namespaces() if name == SPLITTER}
    if not wanted:
        return sorted(found)
    around = [space for space in found if space == wanted or wanted.startswith(f"{space}/")]
    return sorted(around, key=len)[-1:]


def _described(node: Node, namespace: str) -> RunningSensor:
    from rcl_interfaces.srv import GetParameters

    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_processing.ros.services import answer_of

    request = GetParameters.Request(names=["sensor_description", "sensor_name"])
    service = f"{namespace.rstrip('/')}/{SPLITTER}/get_parameters"
    try:
        answer = answer_of(node, GetParameters, service, request, service_s=SEARCH_TIME_S)
    except CmpTactileError:
        return RunningSensor(namespace)
    return RunningSensor(namespace, *(value.string_value for value in answer.values))


@dataclass(frozen=True, kw_only=True)
class Zero(Command):
    """Set displacement and force of a running sensor to zero. Nothing may touch the gel. The next
    frames, for about half a second, are averaged. This calls the service
    stereo_triangulator/set_reference.

    The exit code is 1 if the zero was refused, for example under a load.
    """

    sensor: Annotated[
        str,
        argument(
            "[NAMESPACE]",
            "namespace of the sensor, or one of its topics; needed if several sensors run",
        ),
    ] = ""
    loaded: Annotated[bool, option("zero even if something presses on the gel")] = False

    def run(self) -> int:
        """Ask, and print the answer."""
        from std_srvs.srv import Trigger

        from cmp_tactile_bringup.graphs.running import ZERO
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import SEARCH_S, answer_of

        with Listener("zero") as asking:
            space = find_sensor(asking.node, self.sensor).namespace
            load = "" if self.loaded else _load(asking.node, space)
            if load:
                msg = f"{space}: found {load}, expected nothing to touch the gel"
                raise CmpTactileError(f"{msg}; use --loaded to zero under this load")
            service = f"{space.rstrip('/')}/{ZERO}"
            answer = answer_of(asking.node, Trigger, service, Trigger.Request(), service_s=SEARCH_S)
        return _say(space, answer)


@dataclass(frozen=True, kw_only=True)
class Call(Command):
    """Call a service of a running node, or set parameters of a running node:

      cmp_tactile call replay/pause data:=true
      cmp_tactile call replay/step
      cmp_tactile call replay start:=4.5 rate:=0.5
      cmp_tactile call recorder/record data:=false

    The exit code is 1 if the call was refused. docs/nodes.md lists services and parameters; the
    error for an unknown name lists them, too.
    """

    name: Annotated[
        str,
        argument("SERVICE|NODE", "full name, or the end of it if only one name ends so"),
    ]
    values: Annotated[
        list[str] | None,
        argument("[NAME:=VALUE]", "fields of the request, or parameters of the node"),
    ] = None

    def run(self) -> int:
        """Call, and print the answer."""
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import call, find_service

        with Listener("call") as asking:
            service, kind = find_service(asking.node, self.name)
            answer = call(asking.node, service, kind, self.values or [])
        return _say(service, answer)


@dataclass(frozen=True, kw_only=True)
class Topics(Command):
    """List the topics of all running nodes, with their types. docs/nodes.md describes them."""

    def run(self) -> int:
        """Print one topic in each line; CmpTactileError where no node runs."""
        from cmp_tactile_processing.errors import CmpTactileError
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import RUNNING_NODES, settled

        with Listener("topics") as asking:
            topics = settled(lambda: _topics(asking.node), settled_s=ALL_TOPICS_S)
        if not topics:
            msg = f"found no topics, expected {RUNNING_NODES}"
            raise CmpTactileError(msg)
        width = max(map(len, topics))
        print("\n".join(f"{name:<{width}}  {topics[name]}" for name in sorted(topics)))
        return 0


@dataclass(frozen=True, kw_only=True)
class Echo(Command):
    """Print the messages of a topic until Ctrl-C:

      cmp_tactile echo wrench
      cmp_tactile echo /diagnostics --once

    Long arrays are cut. `cmp_tactile topics` lists all topics.
    """

    name: Annotated[str, argument("TOPIC", "full name, or the end of it")]
    once: Annotated[bool, option("end after one message")] = False

    def run(self) -> int:
        """Print; CmpTactileError for none or several topics of that name, or an unknown type."""
        from contextlib import suppress
        from queue import Empty, SimpleQueue

        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import interface_of
        from cmp_tactile_processing.sensor.yaml_text import dump_yaml

        messages = SimpleQueue[Any]()
        with Listener("echo") as asking:
            topic, kind = _topic(asking.node, self.name)
            qos = _qos(asking.node, topic)
            asking.node.create_subscription(interface_of(kind, topic), topic, messages.put, qos)
            while True:
                with suppress(Empty):  # Ctrl-C is noticed between two of these
                    plain = _plain(messages.get(timeout=WAIT_S))
                    print(f"{dump_yaml(plain)}---", flush=True)
                    if self.once:
                        return 0


def _load(node: Any, namespace: str) -> str:
    """What presses on the gel, in words; "" where nothing does, or no force is known."""
    from math import hypot

    from cmp_tactile_msgs.msg import ForceField
    from cmp_tactile_processing.ros.services import settled

    fields: list[ForceField] = []
    topic = f"{namespace.rstrip('/')}/force_field"
    subscription = node.create_subscription(ForceField, topic, fields.append, 1)
    settled(lambda: bool(fields), FORCE_S)
    node.destroy_subscription(subscription)
    # What is measured against a wrong zero is no reason to keep that.
    if not fields or not fields[-1].contacts or fields[-1].flags & ForceField.FLAG_ZERO_DOUBTFUL:
        return ""
    force, count = fields[-1].wrench.force, len(fields[-1].contacts)
    contacts = "1 contact" if count == 1 else f"{count} contacts"
    return f"a load of {hypot(force.x, force.y, force.z):.2f} N ({contacts})"


def _say(asked: str, answer: Any) -> int:
    """Print what was answered; the exit code."""
    from cmp_tactile_processing.errors import CmpTactileError, printable

    fields = {name: getattr(answer, name) for name in answer.get_fields_and_field_types()}
    text = fields.pop("message", "") or fields.pop("reason", "")
    if not fields.pop("successful", fields.pop("success", True)):
        msg = f"{asked}: refused: {text or 'without a reason'}"
        raise CmpTactileError(msg)
    rest = [f"{name}: {value}" for name, value in fields.items() if value != ""]
    print(printable(f"{asked}: {', '.join(filter(None, [text, *rest])) or 'done'}"))
    return 0


def _topics(node: Any, end: str = "") -> dict[str, str]:
    """Topics of that end that are known by now, with types; but those that every node has."""
    return {
        topic: kinds[0]
        for topic, kinds in node.get_topic_names_and_types()
        if topic.endswith(end) and topic not in OF_ALL_NODES
    }


def _topic(node: Any, name: str) -> tuple[str, str]:
    """Full name and type of the topic whose name ends so, with the fewest names before it."""
    from cmp_tactile_processing.errors import CmpTactileError
    from cmp_tactile_processing.ros.services import RUNNING_NODES, did_you_mean_end, settled

    end = f"/{name.strip('/')}"

    def published() -> dict[str, str]:
        return {t: kind for t, kind in _topics(node, end).items() if node.count_publishers(t)}

    # How a topic is published is asked next; whoever only subscribes to it may be found before.
    found = settled(published) or _topics(node, end)
    least = min((topic.count("/") for topic in found), default=0)
    nearest = sorted(topic for topic in found if topic.count("/") == least)
    if not nearest:
        there = _topics(node)
        wanted = "one that `cmp_tactile topics` lists" if there else RUNNING_NODES
        msg = f"{name}: found no such topic, expected {wanted}"
        raise CmpTactileError(msg + did_you_mean_end(end, there))
    if len(nearest) > 1:
        msg = f"{name}: found several, expected the name of one of: {', '.join(nearest)}"
        raise CmpTactileError(msg)
    return nearest[0], found[nearest[0]]


def _qos(node: Any, topic: str) -> Any:
    """A profile that fits the topic's first publisher."""
    from rclpy.qos import QoSProfile

    offered = node.get_publishers_info_by_topic(topic)
    if not offered:
        return 10
    profile = offered[0].qos_profile
    return QoSProfile(depth=10, reliability=profile.reliability, durability=profile.durability)


def _plain(value: Any) -> Any:
    """A message, or what a field holds, as YAML takes it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return int.from_bytes(value, "little")
    if isinstance(value, (str, int, float)):
        return value
    # A list, array.array or numpy array.
    first = value[:MOST_VALUES]
    items = [_plain(item) for item in (first.tolist() if hasattr(first, "tolist") else first)]
    return [*items, f"... {len(value)} in all"] if len(value) > MOST_VALUES else items


@dataclass(frozen=True, kw_only=True)
class Record(Command):
    """Record topics of a running sensor, on this or another machine, until Ctrl-C. The bag is a
    folder with an MCAP file, metadata.yaml and sensor.yaml, the sensor description. `cmp_tactile
    replay`, `cmp_tactile process`, `ros2 bag` and others read it. To keep frames off the network,
    record in the sensor's own container: give record:=FOLDER to a launch file or to a command
    that starts nodes.
    """

    topics: Annotated[
        list[str] | None,
        argument(
            "TOPIC",
            "topics below the sensor's namespace, or from / on; * stands for any text (default: "
            f"{RecorderParameters.topics})",
        ),
    ] = None
    output: Annotated[
        str,
        option(
            "folder of the bag; it must not exist yet (default: the sensor's name and the time)",
            metavar="FOLDER",
            short="-o",
        ),
    ] = ""
    namespace: Annotated[str, option("namespace of the sensor; needed if several sensors run")] = ""
    sensor: Annotated[
        str | None,
        option("sensor description, instead of the one that the sensor's nodes report"),
    ] = None
    duration: Annotated[float | None, option("end after this time", Number(0.1, 1e6, "s"))] = None
    compression: Annotated[str, _setting("compression")] = RecorderParameters.compression
    jpeg_quality: Annotated[int, _setting("jpeg_quality")] = RecorderParameters.jpeg_quality
    use_sim_time: Annotated[bool, option("log the time of /clock, for example of a replay")] = False

    def run(self) -> int:
        """Record until a signal comes; 0 where all is in the bag."""
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rich.live import Live

        from cmp_tactile_bringup.terminal import output_console
        from cmp_tactile_processing.processes import StopSignal
        from cmp_tactile_processing.ros.process import init_beside, joining_ros

        stop = StopSignal()
        context = Context()
        try:
            with joining_ros():
                init_beside(context)
                recorder = _recorder(self, context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(recorder)
            thread = threading.Thread(target=executor.spin, name="record", daemon=True)
            thread.start()
            console = output_console(stderr=True)
            try:
                with Live(console=console, auto_refresh=False, transient=True) as live:
                    while not stop.wait(PERIOD_S):
                        if _is_over(recorder.progress, self.duration):
                            break
                        if console.is_terminal:
                            live.update(_progress_line(recorder.progress), refresh=True)
            finally:
                missing = recorder.missing_topics
                executor.shutdown()
                thread.join()
                recorder.destroy_node()
            return _summary(recorder.bag, recorder.progress, missing)
        finally:
            context.try_shutdown()


def _recorder(arguments: Record, context: Any) -> Any:
    """The node, in the namespace of the sensor."""
    from rclpy.parameter import Parameter

    from cmp_tactile_driver.nodes.recorder import Recorder
    from cmp_tactile_processing.ros.process import Listener

    with Listener("record_search") as search:
        sensor = find_sensor(search.node, arguments.namespace)
    description = arguments.sensor or sensor.description
    if not description:
        msg = f"{sensor.namespace}: found no description reported by the nodes, expected --sensor"
        raise CmpTactileError(msg)
    values = {
        **{name: getattr(arguments, name) for name in SAME_NAMES},
        "topics": " ".join(arguments.topics or [RecorderParameters.topics]),
        "sensor_description": description,
        "sensor_name": "" if arguments.sensor else sensor.name,
    }
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    overrides.append(Parameter("use_sim_time", value=arguments.use_sim_time))
    return Recorder(
        context=context,
        namespace=sensor.namespace,
        use_global_arguments=False,
        parameter_overrides=overrides,
    )


def _is_over(progress: RecordingProgress | None, duration: float | None) -> bool:
    if progress is None or progress.is_over:
        return True
    return duration is not None and progress.duration_s >= duration


def _progress_line(progress: RecordingProgress | None) -> str:
    if progress is None:
        return ""
    return (
        f"{progress.duration_s:8.1f} s  {sum(progress.messages.values())} messages  "
        f"{progress.size / MEGABYTE:.1f} MB  {sum(progress.dropped.values())} dropped"
    )


def _summary(bag: Path, progress: RecordingProgress, missing: list[str]) -> int:
    from cmp_tactile_bringup.terminal import print_findings

    for topic, count in sorted(progress.messages.items()):
        print(f"{count:8d}  {topic}")
    for topic in missing:
        print(f"       0  {topic}: no node published it")
    for topic, count in sorted(progress.dropped.items()):
        print(f"{count:8d}  {topic}: dropped")
    size = f"{progress.duration_s:.1f} s, {progress.size / MEGABYTE:.1f} MB"
    print(f"{bag}: {sum(progress.messages.values())} messages, {size}")
    print_findings([progress.finding])
    return int(progress.has_failed)
