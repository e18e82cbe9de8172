"""Keeps a graph away from the network: ROS on the loopback interface alone."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

from cmp_tactile_bringup.graphs.rviz import share_folder

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
# Fast DDS 2 of ROS 2 Jazzy reads the second alone; Fast DDS 3 warns where that is set.
PROFILES = "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"
RCLPY_OF_KILTED = 9
# By each of these the user says how nodes are to find one another.
CHOICES = (
    *PROFILES,
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
)
FAST_DDS = ("", "rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")


@contextmanager
def on_loopback() -> Iterator[None]:
    """What joins ROS in here, processes included, uses the loopback interface and shared memory.

    Where ROS_AUTOMATIC_DISCOVERY_RANGE is LOCALHOST, ROS looks for other nodes on this machine
    alone, but its sockets listen on all interfaces.  Not where the user chose something else by the
    environment; with another middleware than Fast DDS only others are looked for on this machine
    alone.
    """
    settings = _local_settings()
    earlier = {name: os.environ[name] for name in settings if name in os.environ}
    os.environ.update(settings)
    try:
        yield
    finally:
        for name in settings:
            del os.environ[name]
        os.environ.update(earlier)


def _local_settings() -> dict[str, str]:
    if os.environ.get(RANGE, "") not in ("", "LOCALHOST"):
        return {}
    if any(os.environ.get(name) for name in CHOICES):
        return {}
    if os.environ.get("RMW_IMPLEMENTATION", "") not in FAST_DDS:
        return {RANGE: "LOCALHOST"}
    is_fast_dds_3 = int(version("rclpy").partition(".")[0]) >= RCLPY_OF_KILTED
    return {
        PROFILES[not is_fast_dds_3]: str(share_folder() / "config" / "dds" / "loopback.xml"),
        # What the profile says; for LOCALHOST rmw would add a transport of its own.
        RANGE: "SYSTEM_DEFAULT",
        # Fast DDS would take a profile from the current folder, too.
        "SKIP_DEFAULT_XML_FILE": "1",
    }
