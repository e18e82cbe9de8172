"""The build of the underlay and of the suite with colcon."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmp_tactile_setup.layout import Layout
from cmp_tactile_setup.machine import RosInstallation
from cmp_tactile_setup.steps import SetupError, digest, read_record, run_step, write_record

SUITE = (
    "cmp_tactile_msgs",
    "cmp_tactile_driver",
    "cmp_tactile_processing",
    "cmp_tactile_simulation",
    "cmp_tactile_viewer",
    "cmp_tactile_bringup",
)
MOST_NAMED = 3
UNDERLAY = ("composition_interfaces", "tf2_msgs", "tf2_ros_py")
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


@dataclass(frozen=True)
class Workspace:
    """What is to be built: the packages, and the ROS 2 that they are built against.

    digests: of each package, by name, the hash of everything that its build depends on.  Installed
    Python modules and shared files are links into the checkout, so their names count but not their
    contents.
    """

    layout: Layout
    flavour: str
    from_wheels: bool
    digests: Mapping[str, str]

    @classmethod
    def from_layout(cls, layout: Layout, ros: RosInstallation | None) -> Workspace:
        """The suite, and those packages of the underlay that the sourced ROS 2 does not bring."""
        missing = [name for name in UNDERLAY if ros is None or ros.prefix_of(name) is None]
        digests = {}
        for name in (*missing, *SUITE):
            folder = _folder_of(layout, name)
            digests[name] = digest(_sources(folder), _linked(folder), layout.root)
        return cls(layout, _flavour(layout, ros), ros is None, digests)

    def changed(self) -> list[str]:
        """The packages that are not built, or that have changed since."""
        built = self._built()
        return [name for name, found in self.digests.items() if built.get(name) != found]

    def is_finished(self) -> bool:
        """Whether the last build was completed and recorded with its environment."""
        record = read_record(self.layout.build_record)
        return record.get("setup") == _setup_digest() and not self.changed()

    def clear_outdated(self) -> None:
        """Remove what was built for another ROS 2, so that the next build starts from nothing."""
        if not self._built():
            self.layout.build_record.unlink(missing_ok=True)
            for folder in (self.layout.build, self.layout.install):
                shutil.rmtree(folder, ignore_errors=True)

    def build(self, changed: Sequence[str], env: Mapping[str, str]) -> None:
        """Build packages. Raises SetupError with the reason if that fails."""
        kept = {name: found for name, found in self._built().items() if name not in changed}
        self._write_record(kept, finished=False)
        self._colcon_build(changed, env)
        _link_command(self.layout)

    def record_finished(self) -> None:
        """Record that everything is built, and the environment written."""
        self._write_record(self.digests, finished=True)

    def _built(self) -> dict[str, Any]:
        """Digest by name of what is built; nothing if it is for another ROS 2 or has leftovers."""
        record = read_record(self.layout.build_record)
        built: dict[str, Any] = record.get("packages", {})
        usable = record.get("flavour") == self.flavour
        return built if usable and built.keys() <= self.digests.keys() else {}

    def _write_record(self, packages: Mapping[str, str], finished: bool) -> None:
        self.layout.install.mkdir(exist_ok=True)
        record = {
            "root": str(self.layout.root),
            "flavour": self.flavour,
            "packages": dict(packages),
            "setup": _setup_digest() if finished else None,
        }
        write_record(self.layout.build_record, record)

    def _colcon_build(self, selected: Sequence[str], env: Mapping[str, str]) -> None:
        layout = self.layout
        log = layout.logs / "build.log"
        command = [
            *(str(layout.venv_python), "-m", "colcon", "--log-base", str(layout.logs), "build"),
            *("--paths", *(str(_folder_of(layout, name)) for name in self.digests)),
            *("--packages-select", *selected),
            *("--build-base", str(layout.build), "--install-base", str(layout.install)),
            "--symlink-install",
            *("--event-handlers", "console_direct+"),
            *("--cmake-args", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release"),
            *(f"-DPython3_EXECUTABLE={layout.venv_python}", "--no-warn-unused-cli"),
            *(["-DCMP_TACTILE_ONLY_PYTHON=ON"] if self.from_wheels else []),
        ]
        few = len(selected) <= MOST_NAMED
        title = f"building {', '.join(selected) if few else f'{len(selected)} packages'}"
        if not run_step(title, command, log, env, layout.root):
            raise SetupError(explain_build_failure(log.read_text(errors="replace"), log))


def _folder_of(layout: Layout, package: str) -> Path:
    return layout.root / ("underlay" if package in UNDERLAY else "") / package


def _flavour(layout: Layout, ros: RosInstallation | None) -> str:
    """What the packages are built against: with another of it they must all be built again."""
    if ros is not None:
        return f"{ros.distro} at {ros.prefix_of('rclpy')}"
    compiled_against = [
        path.relative_to(layout.venv).as_posix()
        for pattern in ("ros_*", "numpy-*")
        for path in layout.venv.glob(f"lib/python3.*/site-packages/{pattern}.dist-info")
    ]
    return hashlib.sha256("\n".join(sorted(compiled_against)).encode()).hexdigest()


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


def _setup_digest() -> str:
    folder = Path(__file__).resolve().parent
    return digest(folder.glob("*.py"), [], folder)


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
