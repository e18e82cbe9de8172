"""Environment variables: those that a build runs in, and those that a user gets afterwards."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Mapping

from .layout import Layout
from .problem import SetupProblem

_SEARCH_PATHS = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
    "LD_LIBRARY_PATH",
    "PKG_CONFIG_PATH",
    "PYTHONPATH",
)
_FROM_OTHER_BUILDS = (
    "AMENT_CURRENT_PREFIX", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "MAKEFLAGS", "MAKELEVEL",
    "MFLAGS", "PYTHONHOME", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__",
)  # fmt: skip
_OF_OTHER_ROS = ("AMENT_PREFIX_PATH", "PYTHONPATH", "ROS_DISTRO", "ROS_VERSION", "ROS_PACKAGE_PATH",
                 "ROS_PYTHON_VERSION", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")  # fmt: skip


def clean_environment(env: Mapping[str, str], with_ros: bool) -> dict[str, str]:
    """`env` without what other builds, and unless `with_ros` other ROS installations, left in it."""
    dropped = set(_FROM_OTHER_BUILDS) | (set() if with_ros else set(_OF_OTHER_ROS))
    if with_ros:
        dropped.discard("CMAKE_PREFIX_PATH")
    return {name: value for name, value in env.items() if name not in dropped}


def build_environment(layout: Layout, clean: Mapping[str, str], with_ros: bool) -> dict[str, str]:
    """The environment in which colcon finds the virtual environment first, and ROS 2 in it."""
    env = dict(clean)
    env["VIRTUAL_ENV"] = str(layout.venv)
    env["PATH"] = f"{layout.venv / 'bin'}:{clean.get('PATH', '/usr/bin:/bin')}"
    if not with_ros:
        libraries = [layout.venv / "lib", *layout.venv.glob("lib/python3.*/site-packages/ros_*.libs")]
        env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = str(layout.venv)
        env["LD_LIBRARY_PATH"] = ":".join(str(path) for path in libraries)
        # The wheels would start Python a second time to set the library path.
        env["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    return env


def write_environment_file(layout: Layout, build_env: Mapping[str, str], with_ros: bool) -> None:
    """Write the file that `setup/env.sh` sources.

    With wheels it holds the finished variables, so that it costs nothing to source; beside a ROS 2
    installation it sources that and the workspace as any ROS 2 workspace does.
    """
    root = shlex.quote(str(layout.root))
    lines = [f"CMP_TACTILE_BUILT_AT={root}"]
    if with_ros:
        setup = shlex.quote(str(layout.install / "setup.sh"))
        lines += [f". {setup}"]
        front = [str(layout.install / "bin"), str(layout.venv / "bin")]
    else:
        after = _after_sourcing(layout, build_env)
        lines += [
            f"export {name}={shlex.quote(after[name])}"
            for name in _SEARCH_PATHS
            if after.get(name) and name != "LD_LIBRARY_PATH"
        ]
        lines += _prepend("LD_LIBRARY_PATH", after.get("LD_LIBRARY_PATH", ""))
        lines += [
            "export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1",
            'export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"',
        ]
        before = build_env["PATH"].split(":")
        added = [entry for entry in after["PATH"].split(":") if entry not in before]
        front = [str(layout.install / "bin"), str(layout.venv / "bin"), *added]
    lines += _prepend("PATH", ":".join(front))
    lines += [f"export VIRTUAL_ENV={shlex.quote(str(layout.venv))}"]
    layout.environment_file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _prepend(name: str, value: str) -> list[str]:
    """Shell lines that put `value` in front of a search path, once however often they are run."""
    quoted = shlex.quote(value)
    return [
        f'case "${{{name}:-}}:" in',
        f"    {quoted}:*) ;;",
        f'    *) export {name}={quoted}"${{{name}:+:${name}}}" ;;',
        "esac",
    ]


def _after_sourcing(layout: Layout, env: Mapping[str, str]) -> dict[str, str]:
    setup = layout.install / "setup.sh"
    command = ["sh", "-c", '. "$1" >/dev/null && env -0', "sh", str(setup)]
    result = subprocess.run(command, env=dict(env), capture_output=True, text=True, check=False)
    if result.returncode != 0:
        raise SetupProblem(f"{setup} cannot be sourced: {result.stderr.strip().splitlines()[-1:]}")
    pairs = (item.partition("=") for item in result.stdout.split("\0") if item)
    return {name: value for name, _, value in pairs}
