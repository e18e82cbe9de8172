"""Checks of the machine, of the checkout's place and of the ROS 2 that the shell has sourced."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from cmp_tactile_setup.steps import SetupError, say

PYTHON_OLDEST = (3, 10)
PYTHON_NEWEST = (3, 14)
# What the distribution's own packages run on, and most of its users with them.
PREFERRED_PYTHONS = {"jazzy": (3, 12)}
GLIBC_OLDEST = (2, 28)
CMAKE_OLDEST = (3, 20)
_UNSAFE_IN_PATH = re.compile(r"[\s:;\"'`$#&|<>()*?\[\]{}!\\]")
# Distributions are named in the order of the alphabet.
_OLDEST_ROS = "jazzy"
# What it is, the commands that may be it, the variable that names another, and the packages of
# Debian and of Fedora that have it.
_TOOLS = (
    ("C compiler", ("cc", "gcc", "clang"), "CC", "gcc", "gcc"),
    ("C++ compiler", ("c++", "g++", "clang++"), "CXX", "g++", "gcc-c++"),
    ("make", ("make", "gmake"), "", "make", "make"),
    ("cmake", ("cmake",), "", "cmake", "cmake"),
)


def check_checkout_path(root: Path) -> None:
    """Raise SetupError if the build tools cannot work below `root`."""
    found = _UNSAFE_IN_PATH.search(str(root))
    if found:
        what = "a space" if found.group() == " " else f"the character {found.group()!r}"
        raise SetupError(
            f"the path of this checkout contains {what}, which the ROS 2 build tools cannot take: "
            f"move it, for example to {Path.home() / 'cmp_tactile'} (it is at '{root}')"
        )


def check_not_moved(root: Path, recorded_root: str | None) -> None:
    """Raise SetupError if the environment was made for another folder than `root`."""
    if recorded_root is not None and recorded_root != str(root):
        raise SetupError(
            f"this checkout was set up at {recorded_root} and is now at {root}, but its "
            "environment holds absolute paths: run 'make clean' and then the same command again"
        )


def better_python(distro: str) -> str | None:
    """Path of an interpreter that suits the wheels better than the running one, or None.

    Raises SetupError if the running one is too old, and says if it is newer than the locked wheels:
    it is tried, since wheels may be served for it by now.
    """
    running = sys.version_info[:2]
    preferred = PREFERRED_PYTHONS.get(distro, PYTHON_NEWEST)
    if PYTHON_OLDEST <= running <= PYTHON_NEWEST:
        # make hands PYTHON on where the user has named one.
        wanted = distro in PREFERRED_PYTHONS and not os.environ.get("PYTHON")
        return find_python(preferred) if wanted and running != preferred else None
    minors = range(PYTHON_NEWEST[1], PYTHON_OLDEST[1] - 1, -1)
    for version in (preferred, *((3, minor) for minor in minors)):
        if found := find_python(version):
            return found
    supported = f"Python {_dotted(PYTHON_OLDEST)} to {_dotted(PYTHON_NEWEST)}"
    if running < PYTHON_OLDEST:
        raise SetupError(
            f"Python {_dotted(running)} is too old: install one of {supported}, with its headers "
            "and venv module"
        )
    say(f"warning: Python {_dotted(running)} is newer than {supported}: trying it")
    return None


def find_python(version: tuple[int, int]) -> str | None:
    """Path of an interpreter of that version which runs, in PATH or in pyenv's folder, or None.

    pyenv puts a script into PATH for each of its interpreters, which fails for those that the user
    has not switched on.
    """
    name = f"python{_dotted(version)}"
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
    of_pyenv = sorted(pyenv.glob(f"versions/{_dotted(version)}.*/bin/{name}"))
    candidates = [shutil.which(name), *(str(path) for path in reversed(of_pyenv))]
    return next((path for path in candidates if path is not None and _runs(path)), None)


def _runs(python: str) -> bool:
    try:
        done = subprocess.run([python, "-c", ""], capture_output=True, check=False)
    except OSError:
        return False
    return done.returncode == 0


def check_platform() -> None:
    """Raise SetupError unless this is Linux x86-64 with a C library that the wheels run on."""
    system, processor = platform.system(), platform.machine()
    if system != "Linux" or processor not in ("x86_64", "AMD64"):
        raise SetupError(
            f"ROS 2 wheels exist for Linux on x86-64 only, this is {system} on {processor}: "
            "install ROS 2 Jazzy or newer, source its setup file and run this again"
        )
    name, version = platform.libc_ver()
    if name != "glibc" or _version_numbers(version) < GLIBC_OLDEST:
        raise SetupError(
            f"ROS 2 wheels need glibc {_dotted(GLIBC_OLDEST)} or newer, "
            f"found {name or 'another C library'} {version}".rstrip()
            + ": use a newer distribution, or install ROS 2 Jazzy or newer and source it"
        )


def check_tools(*, for_venv: bool, for_wheels: bool) -> None:
    """Raise SetupError with everything that is missing to build, and the command to install it.

    for_venv: a virtual environment is to be made, too.  for_wheels: extension modules are compiled
    for the running Python rather than for that of an installed ROS 2.
    """
    python = f"python{_dotted(sys.version_info[:2])}"
    missing = [
        (what, *packages)
        for what, names, variable, *packages in _TOOLS
        if not _has(names, variable)
    ]
    if for_venv:
        absent = (name for name in ("ensurepip", "venv") if find_spec(name) is None)
        missing += [(f"Python's module {n}", f"{python}-venv", "python3-libs") for n in absent]
    header = Path(sysconfig.get_path("include"), "Python.h")
    if for_wheels and not header.is_file():
        missing.append((f"Python's C headers ({header})", f"{python}-dev", "python3-devel"))
    if missing:
        what, debian, fedora = (
            list(dict.fromkeys(column)) for column in zip(*missing, strict=True)
        )
        raise SetupError(
            f"not found: {', '.join(what)}; install with 'sudo apt install {' '.join(debian)}' "
            f"(Debian, Ubuntu) or 'sudo dnf install {' '.join(fedora)}' (Fedora)"
        )
    cmake = [str(shutil.which("cmake")), "--version"]
    done = subprocess.run(cmake, capture_output=True, text=True, check=False)
    version = _version_numbers(done.stdout)
    if version < CMAKE_OLDEST:
        raise SetupError(
            f"cmake {_dotted(version)} is too old: install {_dotted(CMAKE_OLDEST)} or newer, from "
            "your distribution or with 'pip install cmake'"
        )


def _has(names: tuple[str, ...], variable: str) -> bool:
    """Whether one of the commands is there, or the one that the variable names, which must be."""
    chosen = shlex.split(os.environ.get(variable, ""))
    if chosen and not shutil.which(chosen[0]):
        raise SetupError(
            f"found no compiler '{chosen[0]}', which the variable {variable} names: install it, "
            f"or unset {variable}"
        )
    return bool(chosen) or any(shutil.which(name) for name in names)


def _version_numbers(text: str) -> tuple[int, int]:
    found = re.search(r"(\d+)\.(\d+)", text)
    return (int(found.group(1)), int(found.group(2))) if found else (0, 0)


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(str(part) for part in version)


@dataclass(frozen=True)
class RosInstallation:
    """A sourced ROS 2: its distribution and the prefixes of AMENT_PREFIX_PATH that are not ours."""

    distro: str
    prefixes: tuple[Path, ...]

    def prefix_of(self, package: str) -> Path | None:
        """The first prefix that provides the package, or None."""
        found = (p for p in self.prefixes if (p / "share" / package / "package.xml").is_file())
        return next(found, None)


def sourced_ros(env: Mapping[str, str], root: Path) -> RosInstallation | None:
    """The ROS 2 installation that `env` has sourced, or None.

    A virtual environment that holds ROS 2 wheels, this checkout's or another's, is none.
    Raises SetupError for a distribution that is too old.
    """
    distro = env.get("ROS_DISTRO", "")
    prefixes = tuple(
        Path(entry)
        for entry in env.get("AMENT_PREFIX_PATH", "").split(":")
        if entry and not is_below(entry, root) and not (Path(entry) / "pyvenv.cfg").exists()
    )
    installation = RosInstallation(distro, prefixes)
    if not distro or installation.prefix_of("rclpy") is None:
        return None
    if distro < _OLDEST_ROS:
        raise SetupError(
            f"ROS 2 '{distro}' is too old: source Jazzy or newer, or open a shell without ROS 2 "
            "to use wheels"
        )
    return installation


def is_below(path: str, root: Path) -> bool:
    """Whether the path is `root` or lies below it."""
    resolved = Path(path).resolve()
    return root in (resolved, *resolved.parents)
