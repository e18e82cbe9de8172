"""What a result was made with: packages, libraries, ROS and the machine."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("cmp_tactile_processing", "cmp_tactile_driver", "cmp_tactile_bringup")
LIBRARIES = {
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "OpenCV": ("opencv-contrib-python-headless", "opencv-python-headless", "opencv-python"),
    "scikit-fem": ("scikit-fem",),
    "matplotlib": ("matplotlib",),
    "rosbags": ("rosbags",),
}


def machine_facts() -> dict[str, str]:
    """Versions of the suite and its libraries, and the processor; without ROS."""
    suite = ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    libraries = ", ".join(f"{name} {_first_version(names)}" for name, names in LIBRARIES.items())
    return {
        "Suite": suite,
        "Python": platform.python_version(),
        "Libraries": libraries,
        "Machine": f"{processor_name()}, {_usable_cores()} cores, {_memory_gb():.0f} GB",
        "System": f"{_distribution()}, Linux {platform.release()}, {platform.machine()}",
    }


def ros_facts() -> dict[str, str]:
    """Which ROS 2 and which middleware, or that there is none."""
    try:
        from rclpy.utilities import get_rmw_implementation_identifier

        middleware = get_rmw_implementation_identifier()
    except ImportError:
        return {"ROS 2": "not found: rclpy cannot be imported"}
    distribution = os.environ.get("ROS_DISTRO", "from the Python package registry")
    wheels = _first_version(("rclpy", "ros-rclpy"))
    return {"ROS 2": f"{distribution}, rclpy {wheels}, {middleware}"}


def _version(name: str, otherwise: str = "from its source folder") -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return otherwise


def _first_version(names: tuple[str, ...]) -> str:
    installed = (_version(name, "") for name in names)
    return next((text for text in installed if text), "not found")


def processor_name() -> str:
    """Type of this machine's processor."""
    for line in _lines("/proc/cpuinfo"):
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.processor() or platform.machine()


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0))


def _memory_gb() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9


def _distribution() -> str:
    for line in _lines("/etc/os-release"):
        if line.startswith("PRETTY_NAME="):
            return line.partition("=")[2].strip('"')
    return platform.system()


def _lines(path: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
