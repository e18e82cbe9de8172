"""`cmp_tactile zero`, `call`, `topics`, `echo`: use nodes that run where there is no `ros2`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from cmp_tactile_bringup.commands.options import Command, argument, option

# In which a force comes from a sensor that runs; one without is zeroed all the same.
FORCE_S = 3.0
MOST_VALUES = 12
OF_ALL_NODES = "/parameter_events", "/rosout"
WAIT_S = 0.5
# Nodes are discovered one after the other; on a busy machine a second may pass between two.
ALL_TOPICS_S = 2.0


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

        from cmp_tactile_bringup.commands.running_sensor import RunningSensorError, find_sensor
        from cmp_tactile_bringup.graphs.running import ZERO
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import SEARCH_S, answer_of

        with Listener("zero") as asking:
            space = find_sensor(asking.node, self.sensor).namespace
            load = "" if self.loaded else _load(asking.node, space)
            if load:
                msg = f"{space}: found {load}, expected nothing to touch the gel"
                raise RunningSensorError(f"{msg}; use --loaded to zero under this load")
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
        """Print one topic in each line; ServiceError where no node runs."""
        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import RUNNING_NODES, ServiceError, settled

        with Listener("topics") as asking:
            topics = settled(lambda: _topics(asking.node), settled_s=ALL_TOPICS_S)
        if not topics:
            msg = f"found no topics, expected {RUNNING_NODES}"
            raise ServiceError(msg)
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
        """Print; ServiceError for none or several topics of that name, or an unknown type."""
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
    from cmp_tactile_processing.errors import printable
    from cmp_tactile_processing.ros.services import ServiceError

    fields = {name: getattr(answer, name) for name in answer.get_fields_and_field_types()}
    text = fields.pop("message", "") or fields.pop("reason", "")
    if not fields.pop("successful", fields.pop("success", True)):
        msg = f"{asked}: refused: {text or 'without a reason'}"
        raise ServiceError(msg)
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
    from cmp_tactile_processing.ros.services import (
        RUNNING_NODES,
        ServiceError,
        did_you_mean_end,
        settled,
    )

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
        raise ServiceError(msg + did_you_mean_end(end, there))
    if len(nearest) > 1:
        msg = f"{name}: found several, expected the name of one of: {', '.join(nearest)}"
        raise ServiceError(msg)
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
