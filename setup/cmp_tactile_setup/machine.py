"""Checks of the machine and of the checkout's place, before anything is written."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import NoReturn

from cmp_tactile_setup.errors import SetupError

PYTHON_OLDEST = (3, 10)
PYTHON_NEWEST = (3, 13)
GLIBC_OLDEST = (2, 28)
CMAKE_OLDEST = (3, 20)
UNSAFE_IN_PATH = re.compile(r"[\s:;\"'`$#&|<>()*?\[\]{}!\\]")


def check_checkout_path(root: Path) -> None:
    """Raise SetupError if the build tools cannot work below `root`."""
    found = UNSAFE_IN_PATH.search(str(root))
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


def is_supported_python(version: tuple[int, int]) -> bool:
    """Whether wheels exist for this version of Python."""
    return PYTHON_OLDEST <= version <= PYTHON_NEWEST


def other_supported_python() -> str | None:
    """Path of a supported interpreter in PATH, the newest, or None."""
    for minor in range(PYTHON_NEWEST[1], PYTHON_OLDEST[1] - 1, -1):
        found = shutil.which(f"python3.{minor}")
        if found:
            return found
    return None


def unsupported_python(version: tuple[int, int]) -> SetupError:
    """What to say where there is no interpreter that wheels exist for."""
    return SetupError(
        f"Python {_dotted(version)} is not supported: install one of Python "
        f"{_dotted(PYTHON_OLDEST)} to {_dotted(PYTHON_NEWEST)}, with its headers and venv module"
    )


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


def check_venv() -> None:
    """Raise SetupError if this Python cannot make a virtual environment with pip."""
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError as error:
        version = _dotted(sys.version_info[:2])
        raise SetupError(
            f"Python's module '{error.name}' is missing: install it "
            f"(Debian, Ubuntu: sudo apt install python{version}-venv)"
        ) from None


def check_python_headers() -> None:
    """Raise SetupError if extension modules cannot be compiled for this Python."""
    include = Path(sysconfig.get_path("include"))
    if not (include / "Python.h").is_file():
        version = _dotted(sys.version_info[:2])
        raise SetupError(
            f"Python's C headers are missing ({include / 'Python.h'}): install them "
            f"(Debian, Ubuntu: sudo apt install python{version}-dev; Fedora: python3-devel)"
        )


def check_build_tools() -> None:
    """Raise SetupError if a compiler, cmake or make is missing or too old."""
    _require_compiler("CC", ("cc", "gcc", "clang"), "C compiler", "gcc")
    _require_compiler("CXX", ("c++", "g++", "clang++"), "C++ compiler", "g++")
    if not (shutil.which("make") or shutil.which("gmake")):
        _missing("make", "make")
    cmake = shutil.which("cmake")
    if cmake is None:
        _missing("cmake", "cmake")
    output = subprocess.run([cmake, "--version"], capture_output=True, text=True, check=False)
    version = _version_numbers(output.stdout)
    if version < CMAKE_OLDEST:
        raise SetupError(
            f"cmake {_dotted(version)} ({cmake}) is too old: install {_dotted(CMAKE_OLDEST)} "
            "or newer"
        )


def _require_compiler(variable: str, names: tuple[str, ...], what: str, package: str) -> None:
    chosen = shlex.split(os.environ.get(variable, ""))
    if chosen and not shutil.which(chosen[0]):
        raise SetupError(
            f"the {what} '{chosen[0]}' that the variable {variable} names does not exist: "
            f"install it or unset {variable}"
        )
    if not chosen and not any(shutil.which(name) for name in names):
        _missing(what, package)


def _missing(what: str, package: str) -> NoReturn:
    raise SetupError(
        f"{what} not found: install it (Debian, Ubuntu: sudo apt install {package}; "
        f"Fedora: sudo dnf install {'gcc-c++' if package == 'g++' else package})"
    )


def _version_numbers(text: str) -> tuple[int, int]:
    found = re.search(r"(\d+)\.(\d+)", text)
    return (int(found.group(1)), int(found.group(2))) if found else (0, 0)


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(str(part) for part in version)
