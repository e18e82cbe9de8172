"""The suite's own messages for `rosbags`, from their definition files, without ROS."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cmp_tactile_processing.errors import MessageDefinitionError

__all__ = ["CONTACT", "FORCE_FIELD", "GRID", "SURFACE", "simulation_typestore"]

PACKAGE = "cmp_tactile_msgs"
GRID = f"{PACKAGE}/msg/Grid"
SURFACE = f"{PACKAGE}/msg/Surface"
CONTACT = f"{PACKAGE}/msg/Contact"
FORCE_FIELD = f"{PACKAGE}/msg/ForceField"
KINDS = ("Grid", "Surface", "Contact", "ForceField")


@cache
def simulation_typestore() -> Typestore:
    """ROS 2's message types and those of cmp_tactile_msgs.

    Raises MessageDefinitionError where the definitions are not installed.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = _definition_folder()
    for name in (GRID, SURFACE, CONTACT, FORCE_FIELD):
        path = folder / f"{name.rpartition('/')[2]}.msg"
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), name))
    return store


def _definition_folder() -> Path:
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" / PACKAGE / "msg" for prefix in prefixes if prefix]
    folders.append(Path(__file__).resolve().parents[4] / PACKAGE / "msg")
    for folder in folders:
        if all((folder / f"{kind}.msg").is_file() for kind in KINDS):
            return folder
    needed = ", ".join(f"{kind}.msg" for kind in KINDS)
    searched = ", ".join(str(folder) for folder in folders)
    msg = f"{PACKAGE}: found no {needed} in any of {searched}"
    raise MessageDefinitionError(msg)
