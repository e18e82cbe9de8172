"""The build of the underlay and of the suite with colcon."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .layout import Layout
from .problem import SetupProblem
from .progress import run_step
from .record import digest, read_record, write_record
from .ros_installation import RosInstallation

SUITE = (
    "cmp_tactile_msgs",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_bringup",
)
UNDERLAY = ("composition_interfaces", "cv_bridge", "tf2_msgs", "tf2_ros_py")
_SHARED_FOLDERS = ("config", "data", "launch", "rviz")
_INTERFACES = ("msg", "srv", "action")


@dataclass(frozen=True)
class Package:
    """A package of this checkout and the hash of everything that its build depends on.

    Installed Python modules and shared files are links into the checkout, so their names count
    but not their contents.
    """

    name: str
    folder: Path
    digest: str


def packages_to_build(layout: Layout, ros: RosInstallation | None) -> list[Package]:
    """The suite, and those packages of the underlay that the sourced ROS 2 does not bring."""
    missing = [name for name in UNDERLAY if ros is None or not ros.has_package(name)]
    folders = [layout.root / "underlay" / name for name in missing]
    folders += [layout.root / name for name in SUITE]
    return [
        Package(folder.name, folder, digest(_sources(folder), _linked(folder), layout.root))
        for folder in folders
    ]


def ensure_built(
    layout: Layout, packages: list[Package], flavour: str, env: Mapping[str, str]
) -> bool:
    """Build the packages that changed since the last build; True if there were any.

    flavour: names what the packages are built against; a build against something else, or of
    packages that exist no more, is removed first.
    """
    record = read_record(layout.build_record)
    built: dict[str, Any] = record.get("packages", {})
    wanted = {package.name: package.digest for package in packages}
    if record.get("flavour") != flavour or not built.keys() <= wanted.keys():
        built = {}
        forget(layout)
    changed = [package for package in packages if built.get(package.name) != package.digest]
    if not changed:
        return False
    layout.build_record.unlink(missing_ok=True)
    _colcon_build(layout, packages, [package.name for package in changed], env)
    _link_command(layout)
    write_record(
        layout.build_record, {"root": str(layout.root), "flavour": flavour, "packages": wanted}
    )
    return True


def forget(layout: Layout) -> None:
    """Make the next build start from nothing, because what it is built against is another."""
    for folder in (layout.build, layout.install):
        shutil.rmtree(folder, ignore_errors=True)


def _colcon_build(
    layout: Layout, packages: list[Package], selected: list[str], env: Mapping[str, str]
) -> None:
    log = layout.logs / "build.log"
    command = [
        str(layout.venv_python), "-m", "colcon", "--log-base", str(layout.logs), "build",
        "--paths", *(str(package.folder) for package in packages),
        "--packages-select", *selected,
        "--build-base", str(layout.build), "--install-base", str(layout.install),
        "--symlink-install",
        "--event-handlers", "console_direct+",
        "--cmake-args", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release",
        f"-DPython3_EXECUTABLE={layout.venv_python}", "--no-warn-unused-cli",
    ]  # fmt: skip
    title = f"building {len(selected)} packages"
    if not run_step(title, command, log, env, layout.root):
        raise SetupProblem(explain_build_failure(log.read_text(errors="replace"), log))


def explain_build_failure(output: str, log: Path) -> str:
    """One line on which package failed and why, from the output of colcon."""
    failed = re.findall(r"Failed\s+<<< (\S+)", output)
    lines = [line.strip() for line in output.splitlines()]
    reasons = [line for line in lines if re.search(r"\berror\b|Error\b", line, re.IGNORECASE)]
    reason = reasons[0] if reasons else "no reason given"
    return f"building {', '.join(failed) or 'the packages'} failed: {reason} (log: {log})"


def _link_command(layout: Layout) -> None:
    """Put `cmp_tactile` into `install/bin`, the one folder of ours in PATH."""
    command = Path("cmp_tactile_bringup", "lib", "cmp_tactile_bringup", "cmp_tactile")
    link = layout.install / "bin" / "cmp_tactile"
    link.parent.mkdir(exist_ok=True)
    if not link.is_symlink():
        link.symlink_to(Path("..") / command)


def _sources(folder: Path) -> Iterator[Path]:
    for name in ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt"):
        if (folder / name).is_file():
            yield folder / name
    for interface in _INTERFACES:
        yield from (folder / interface).glob(f"*.{interface}")
    yield from (path for path in (folder / "resource").rglob("*") if path.is_file())


def _linked(folder: Path) -> Iterator[Path]:
    for shared in _SHARED_FOLDERS:
        yield from (path for path in (folder / shared).rglob("*") if path.is_file())
    yield from folder.glob("*/__init__.py")
