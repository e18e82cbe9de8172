"""`cmp_tactile topics`, `echo`: what running nodes publish, where there is no `ros2`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from cmp_tactile_bringup.commands.options import Command, argument, option

MOST_VALUES = 12
OF_ALL_NODES = "/parameter_events", "/rosout"
WAIT_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Topics(Command):
    """List the topics of all running nodes, with their types. docs/nodes.md describes them."""

    def run(self) -> int:
        """Print one topic in each line; ServiceError where no node runs."""
        from cmp_tactile_processing.ros.process import Listener

        with Listener("topics") as asking:
            topics = _topics(asking.node)
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

        import yaml

        from cmp_tactile_processing.ros.process import Listener
        from cmp_tactile_processing.ros.services import interface_of

        messages = SimpleQueue[Any]()
        with Listener("echo") as asking:
            topic, kind = _topic(asking.node, self.name)
            qos = _qos(asking.node, topic)
            asking.node.create_subscription(interface_of(kind, topic), topic, messages.put, qos)
            while True:
                with suppress(Empty):  # Ctrl-C is noticed between two of these
                    plain = _plain(messages.get(timeout=WAIT_S))
                    text = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None)
                    print(f"{text}---", flush=True)
                    if self.once:
                        return 0


def _topics(node: Any, end: str = "") -> dict[str, str]:
    """Topics whose names end so, with their types; but those that every node has."""
    from cmp_tactile_processing.ros.services import ServiceError, settled

    def found() -> dict[str, str]:
        topics = node.get_topic_names_and_types()
        return {t: kinds[0] for t, kinds in topics if t.endswith(end) and t not in OF_ALL_NODES}

    topics = settled(found)
    if not topics and not end:
        msg = "found no topics, expected running nodes; is ROS_DOMAIN_ID the same?"
        raise ServiceError(msg)
    return topics


def _topic(node: Any, name: str) -> tuple[str, str]:
    """Full name and type of the topic whose name ends so, with the fewest names before it."""
    from cmp_tactile_processing.ros.services import ServiceError, did_you_mean_end

    end = f"/{name.strip('/')}"
    found = _topics(node, end)
    least = min((topic.count("/") for topic in found), default=0)
    nearest = sorted(topic for topic in found if topic.count("/") == least)
    if not nearest:
        msg = f"{name}: found no such topic, expected one that `cmp_tactile topics` lists"
        raise ServiceError(msg + did_you_mean_end(end, _topics(node)))
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
