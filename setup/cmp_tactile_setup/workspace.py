"""The build of the underlay and of the suite with colcon."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cmp_tactile_setup.layout import Layout
from cmp_tactile_setup.steps import SetupError, digest, read_record, run_step, write_record

SUITE = (
    "cmp_tactile_msgs",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_simulation",
    "cmp_tactile_viewer",
    "cmp_tactile_bringup",
)
UNDERLAY = ("composition_interfaces", "cv_bridge", "tf2_msgs", "tf2_ros_py")
_MANIFESTS = ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt")
_INTERFACES = ("msg", "srv", "action")
_SHARED_FOLDERS = ("config", "data", "launch", "rviz", "scenes")
# What the message generators, Python, compilers and CMake say, the clearest first.
_REASONS = (
    re.compile(r"^ *Error processing .*$", re.MULTILINE),
    re.compile(r"^\S*Error: .*$|^.*\berror: .*$", re.MULTILINE),
    re.compile(r"^ *Could not find a package .* provided by .*$", re.MULTILINE),
    re.compile(r"^CMake Error.*$", re.MULTILINE),
)


def is_current(layout: Layout) -> bool:
    """Whether the last build was completed, of these sources and for this ROS 2."""
    return read_record(layout.build_record) == _record(layout)


def clear_outdated(layout: Layout) -> None:
    """Remove what was built for another ROS 2 or has leftovers, and is to be built again."""
    built, wanted = read_record(layout.build_record), _record(layout)
    if any(built.get(key) != wanted[key] for key in ("built_against", "packages")):
        for folder in (layout.build, layout.install):
            shutil.rmtree(folder, ignore_errors=True)


def build(layout: Layout, env: Mapping[str, str]) -> None:
    """Build what has changed.  Raises SetupError with the reason if that fails."""
    layout.install.mkdir(exist_ok=True)
    # A build that fails is not current, also once the sources are as they were before.
    write_record(layout.build_record, {**_record(layout), "sources": None})
    log = layout.logs / "build.log"
    command = [
        *(str(layout.venv_python), "-m", "colcon", "--log-base", str(layout.logs), "build"),
        *("--paths", *map(str, _folders(layout))),
        *("--build-base", str(layout.build), "--install-base", str(layout.install)),
        "--symlink-install",
        *("--event-handlers", "console_direct+"),
        *("--cmake-args", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release"),
        *(f"-DPython3_EXECUTABLE={layout.venv_python}", "--no-warn-unused-cli"),
        f"-DCMP_TACTILE_ONLY_PYTHON={'OFF' if layout.cpp else 'ON'}",
    ]
    if not run_step("building the packages", command, log, env, layout.root):
        raise SetupError(explain_build_failure(log.read_text(errors="replace"), log))
    _link_command(layout)


def record_finished(layout: Layout) -> None:
    """Record that everything is built, and the environment written."""
    write_record(layout.build_record, _record(layout))


def _folders(layout: Layout) -> list[Path]:
    """Of the suite, and of those packages of the underlay that the sourced ROS 2 lacks."""
    ros = layout.ros
    missing = (name for name in UNDERLAY if ros is None or ros.prefix_of(name) is None)
    underlay = [layout.root / "underlay" / name for name in missing]
    return [*underlay, *(layout.root / name for name in SUITE)]


def _record(layout: Layout) -> dict[str, Any]:
    """What the packages are built from.

    Installed Python modules and shared files are links into the checkout, so their names count but
    not their contents.
    """
    folders = _folders(layout)
    contents = [path for folder in folders for path in _sources(folder)]
    names = [path for folder in folders for path in _linked(folder)]
    set_up = layout.root.glob("setup/cmp_tactile_setup/*.py")
    return {
        "root": str(layout.root),
        "cpp": layout.cpp,
        "built_against": _built_against(layout),
        "packages": [folder.name for folder in folders],
        "sources": digest([*contents, *set_up], names, layout.root),
    }


def _built_against(layout: Layout) -> str:
    """With another of it the packages must all be built again."""
    if layout.ros is not None:
        return f"{layout.ros.distro} at {layout.ros.prefix_of('rclpy')}"
    compiled_against = [
        path.name
        for pattern in ("ros_*", "numpy-*")
        for path in layout.venv.glob(f"lib/python3.*/site-packages/{pattern}.dist-info")
    ]
    return " ".join(sorted(compiled_against))


def explain_build_failure(output: str, log: Path) -> str:
    """One line on which package failed and why, from the output of colcon."""
    failed = re.findall(r"Failed\s+<<< (\S+)", output)
    reason = next((m for p in _REASONS if (m := p.search(output))), None)
    text = reason.group().strip() if reason else "no reason given"
    return f"building {', '.join(failed) or 'the packages'} failed: {text} (log: {log})"


def _link_command(layout: Layout) -> None:
    """Put `cmp_tactile` into `install/bin`, the one folder of the suite in PATH."""
    command = Path("cmp_tactile_bringup", "lib", "cmp_tactile_bringup", "cmp_tactile")
    link = layout.install / "bin" / "cmp_tactile"
    link.parent.mkdir(exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(Path("..") / command)


def _sources(folder: Path) -> Iterator[Path]:
    yield from (folder / name for name in _MANIFESTS if (folder / name).is_file())
    for interface in _INTERFACES:
        yield from (folder / interface).glob(f"*.{interface}")
    yield from _files_below(folder / "resource")


def _linked(folder: Path) -> Iterator[Path]:
    for shared in _SHARED_FOLDERS:
        yield from _files_below(folder / shared)
    yield from folder.glob("*/__init__.py")


def _files_below(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file())
