"""Types of messages without ROS: their definitions as installed, and messages of `rosbags`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cmp_tactile_processing.cache.files import packaged_files
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.ros.messages import making

SEPARATOR = "=" * 80
NUMBERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
PRIMITIVES = NUMBERS | {"bool", "byte", "char", "float32", "float64", "string", "wstring"}


@cache
def simulation_typestore() -> Typestore:
    """ROS 2's message types and those of cmp_tactile_msgs.

    Raises CmpTactileError where the definitions are not installed.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in making.OUR_TYPES:
        text = _file(kind, ".msg").read_text(encoding="utf-8")
        store.register(get_types_from_msg(text, kind))
    return store


def bag_messages() -> making.MessageMaker:
    """Makes messages that `simulation_typestore` serialises; raises what that does."""
    types = simulation_typestore().types

    def new(kind: str, **values: Any) -> Any:
        return types[kind](**values)

    return making.MessageMaker(new)


@dataclass(frozen=True)
class MessageDefinition:
    """A type's definition with those that it is made of after it, and its RIHS01 hash."""

    text: str
    type_hash: str


@cache
def simulation_definition(kind: str) -> MessageDefinition:
    """The definition of a type of `simulation_typestore`, without comments; raises what that does.

    The other messages of ROS 2 need not be installed.
    """
    store = simulation_typestore()
    return MessageDefinition(store.generate_msgdef(kind, ros_version=2)[0], store.hash_rihs01(kind))


@cache
def message_definition(message_type: str) -> MessageDefinition:
    """The definition of a type such as "sensor_msgs/msg/Image", as a bag keeps it.

    Raises CmpTactileError where its package, or one that it needs, has none here.
    """
    texts: dict[str, str] = {}
    missing = [message_type]
    while missing:
        name = missing.pop(0)
        if name not in texts:
            texts[name] = _file(name, ".msg").read_text(encoding="utf-8")
            missing += _parts(name, texts[name])
    first, *others = texts
    joined = [texts[first]]
    for name in others:
        package, _, kind = name.split("/")
        joined.append(f"{SEPARATOR}\nMSG: {package}/{kind}\n{texts[name]}")
    hashes = json.loads(_file(message_type, ".json").read_text(encoding="utf-8"))["type_hashes"]
    by_name = {item["type_name"]: str(item["hash_string"]) for item in hashes}
    return MessageDefinition("\n".join(joined), by_name.get(message_type, ""))


def _parts(owner: str, text: str) -> list[str]:
    """The types, but for primitive ones, of the fields that a definition has."""
    found = []
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        kind = words[0].partition("[")[0].partition("<")[0] if words else ""
        if not kind or kind in PRIMITIVES:
            continue
        package = (kind if "/" in kind else owner).partition("/")[0]
        found.append(f"{package}/msg/{kind.rpartition('/')[2]}")
    return found


def _file(message_type: str, suffix: str) -> Path:
    package, _, name = message_type.split("/")
    found = packaged_files(package, f"msg/{name}{suffix}")
    if not found:
        msg = f"{message_type}: found no {name}{suffix} in the share folders of AMENT_PREFIX_PATH"
        raise CmpTactileError(msg)
    return found[name]
