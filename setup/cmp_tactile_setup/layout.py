"""Where things lie in a checkout: once for each ROS 2 distribution that it is set up for.

And environment variables: those that a build runs in, and those that a user gets afterwards.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Mapping
from pathlib import Path

from cmp_tactile_setup.machine import RosInstallation, is_below
from cmp_tactile_setup.steps import SetupError, read_record, replace_file

# The distributions that wheels exist for; the first is what a checkout is set up for by default.
DISTRIBUTIONS = ("kilted", "jazzy")


def chosen_distribution(value: str, ros: RosInstallation | None) -> str:
    """The distribution that the variable CMP_TACTILE_ROS names.

    Raises SetupError if there are no wheels of it, or another ROS 2 is sourced.
    """
    distro = value or DISTRIBUTIONS[0]
    if distro not in DISTRIBUTIONS:
        raise SetupError(
            f"CMP_TACTILE_ROS={value}: found no wheels for it, expected "
            f"{' and '.join(DISTRIBUTIONS)}; unset this variable, or set it to one of these"
        )
    if value and ros is not None and ros.distro != value:
        raise SetupError(
            f"CMP_TACTILE_ROS={value} asks for {value}, but this shell has sourced ROS 2 "
            f"'{ros.distro}': open a shell without ROS 2 to use wheels, or unset this variable"
        )
    return distro


class Layout:
    """Paths of one checkout; `root` is absolute and free of symbolic links.

    Each of the `DISTRIBUTIONS` has folders of its own, so that they lie side by side.
    ros: the ROS 2 that is sourced; None for wheels.
    """

    def __init__(
        self, root: Path, distro: str = DISTRIBUTIONS[0], ros: RosInstallation | None = None
    ) -> None:
        suffix = "" if distro == DISTRIBUTIONS[0] else f"-{distro}"
        self.root, self.distro, self.ros = root, distro, ros
        # Held by the set-up that runs.
        self.lock = root / ".setup.lock"
        self.venv = root / f".venv{suffix}"
        self.venv_python = self.venv / "bin" / "python"
        # Where the packages are built and installed, and the output of each step is kept.
        self.build = root / f"build{suffix}"
        self.install = root / f"install{suffix}"
        self.logs = root / f"log{suffix}"
        # What these were made from, once they are complete.
        self.venv_record = self.venv / "cmp_tactile_wheels.json"
        self.build_record = self.install / "cmp_tactile_build.json"
        # Whether messages are built for C++, too: rosbag2 and other C++ nodes need it, ours do not.
        self.cpp: bool = (
            ros is not None
            or os.environ.get("CMP_TACTILE_CPP") == "1"
            or read_record(self.build_record).get("cpp", False)
        )
        # What setup/env.sh sources.
        self.environment_file = self.install / "cmp_tactile_environment.sh"

    def requirements(self, name: str) -> Path:
        """A requirements file of that name."""
        return self.root / "setup" / name


_REPLACED_PATHS = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "COLCON_PREFIX_PATH",
    "PKG_CONFIG_PATH",
    "PYTHONPATH",
)
_OF_OTHER_BUILDS = (
    "AMENT_CURRENT_PREFIX",
    "COLCON_PREFIX_PATH",
    "MAKEFLAGS",
    "MAKELEVEL",
    "MFLAGS",
    "PYTHONHOME",
    "VIRTUAL_ENV",
    "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
    "__PYVENV_LAUNCHER__",
)
_OF_OTHER_ROS = (
    "AMENT_PREFIX_PATH",
    "CMAKE_PREFIX_PATH",
    "PYTHONPATH",
    "ROS_DISTRO",
    "ROS_PACKAGE_PATH",
    "ROS_PYTHON_VERSION",
    "ROS_VERSION",
)


def clean_environment(env: Mapping[str, str], layout: Layout) -> dict[str, str]:
    """`env` without the traces of other builds and, with wheels, of other ROS 2."""
    dropped = {*_OF_OTHER_BUILDS, *(_OF_OTHER_ROS if layout.ros is None else ())}
    clean = {name: value for name, value in env.items() if name not in dropped}
    for name in {*_REPLACED_PATHS, "LD_LIBRARY_PATH"} & clean.keys():
        entries = [e for e in clean[name].split(":") if e and not is_below(e, layout.root)]
        clean[name] = ":".join(entries)
    return clean


def build_environment(layout: Layout, clean: Mapping[str, str]) -> dict[str, str]:
    """The environment in which colcon finds the virtual environment first, and ROS 2 in it."""
    env = dict(clean)
    env["VIRTUAL_ENV"] = str(layout.venv)
    env["PATH"] = f"{layout.venv / 'bin'}:{clean.get('PATH', '/usr/bin:/bin')}"
    if layout.ros is None:
        bundled = sorted(layout.venv.glob("lib/python3.*/site-packages/ros_*.libs"))
        env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = str(layout.venv)
        env["LD_LIBRARY_PATH"] = ":".join(str(path) for path in (layout.venv / "lib", *bundled))
        # The wheels would start Python a second time to set the library path.
        env["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    return env


def write_environment_file(layout: Layout, build_env: Mapping[str, str]) -> None:
    """Write the file that `setup/env.sh` sources.

    With wheels it holds the finished variables, so that it costs nothing to source; beside a ROS 2
    installation it sources that and the workspace as any ROS 2 workspace does.
    """
    sourcing = [f". {shlex.quote(str(layout.install / 'setup.sh'))}"]
    lines = [
        f"CMP_TACTILE_BUILT_AT={shlex.quote(str(layout.root))}",
        *(_finished_lines(layout, build_env) if layout.ros is None else sourcing),
        *_prepend("PATH", f"{layout.install / 'bin'}:{layout.venv / 'bin'}"),
        f"export VIRTUAL_ENV={shlex.quote(str(layout.venv))}",
    ]
    replace_file(layout.environment_file, "\n".join(lines) + "\n")


def _finished_lines(layout: Layout, build_env: Mapping[str, str]) -> list[str]:
    after = _after_sourcing(layout, build_env)
    return [
        *(f"export {n}={shlex.quote(after[n])}" for n in _REPLACED_PATHS if after.get(n)),
        *_prepend("LD_LIBRARY_PATH", after["LD_LIBRARY_PATH"]),
        "export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1",
        'export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"',
    ]


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
    done = subprocess.run(command, env=dict(env), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SetupError(f"{setup} cannot be sourced: {done.stderr.strip() or 'no reason given'}")
    pairs = (item.partition("=") for item in done.stdout.split("\0") if item)
    return {name: value for name, _, value in pairs}
