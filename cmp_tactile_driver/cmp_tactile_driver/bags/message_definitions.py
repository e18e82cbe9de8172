"""Definitions of message types as a bag keeps them, from the installed packages, without ROS."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from cmp_tactile_driver.errors import BagError

__all__ = ["MessageDefinition", "message_definition"]

SEPARATOR = "=" * 80
NUMBERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
PRIMITIVES = NUMBERS | {"bool", "byte", "char", "float32", "float64", "string", "wstring"}


@dataclass(frozen=True)
class MessageDefinition:
    """A type's definition with those that it is made of after it, and its RIHS01 hash."""

    text: str
    type_hash: str


@cache
def message_definition(message_type: str) -> MessageDefinition:
    """The definition of a type such as "sensor_msgs/msg/Image".

    Raises BagError where its package, or one that it needs, has no definition here.
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
    return MessageDefinition("\n".join(joined), _type_hash(message_type))


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


def _type_hash(message_type: str) -> str:
    content = json.loads(_file(message_type, ".json").read_text(encoding="utf-8"))
    for item in content["type_hashes"]:
        if item["type_name"] == message_type:
            return str(item["hash_string"])
    return ""


def _file(message_type: str, suffix: str) -> Path:
    package, _, name = message_type.split("/")
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / "msg" / f"{name}{suffix}"
        if path.is_file():
            return path
    searched = ", ".join(prefixes) or "none: AMENT_PREFIX_PATH is empty"
    msg = f"{message_type}: found no {name}{suffix} in the share folders of {searched}"
    raise BagError(msg)
