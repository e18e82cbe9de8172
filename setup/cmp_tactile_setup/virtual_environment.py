"""The virtual environment of a checkout: the wheels of ROS 2, or what a ROS 2 machine lacks."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path

from .layout import Layout
from .problem import SetupProblem
from .progress import run_step, say
from .record import digest, read_record, write_record
from .wheel_repair import repair_prefix

_NETWORK = re.compile(
    r"NewConnectionError|NameResolutionError|Temporary failure in name resolution|ConnectTimeout"
    r"|ReadTimeout|ConnectionResetError|Connection refused|Could not fetch URL|ProxyError|SSLError"
)
_NO_SPACE = re.compile(r"No space left on device")


def ensure_wheels(layout: Layout, env: Mapping[str, str]) -> bool:
    """Make `.venv` with ROS 2 and all libraries unless it is there; True if it was made anew.

    An environment whose record is missing was interrupted, and is made from the start.
    """
    requirements = layout.requirements("requirements-kilted.txt")
    wanted = {
        "root": str(layout.root),
        "python": _running_python(),
        "requirements": digest([requirements], [], layout.root),
    }
    if read_record(layout.venv_record) == wanted and layout.venv_python.exists():
        return False
    say(f"ROS 2 Kilted from wheels, once, into .venv (Python {wanted['python']}, 1 GB)")
    _make_venv(layout, env, ["--clear"])
    _pip_install(layout, ["-r", str(requirements)], "installing wheels", env)
    repair(layout)
    write_record(layout.venv_record, wanted)
    return True


def ensure_missing_libraries(layout: Layout, env: Mapping[str, str]) -> bool:
    """Beside a sourced ROS 2: make `.venv` on top of the system's Python with what it lacks.

    Libraries that the system has are used as they are, because ROS 2 was compiled against them.
    """
    requirements = layout.requirements("requirements-with-ros.txt")
    wanted = {
        "root": str(layout.root),
        "python": _running_python(),
        "requirements": digest([requirements], [], layout.root),
        "ros": env["ROS_DISTRO"],
    }
    if read_record(layout.venv_record) == wanted and layout.venv_python.exists():
        return False
    say("libraries that ROS 2 does not bring, once, into .venv")
    _make_venv(layout, env, ["--clear", "--system-site-packages"])
    missing = _missing_requirements(layout, requirements, env)
    if missing:
        constraints = layout.venv / "constraints.txt"
        constraints.write_text(_installed_numpy(layout, env), encoding="utf-8")
        command = ["-c", str(constraints), *missing]
        _pip_install(layout, command, f"installing {len(missing)} libraries", env)
    write_record(layout.venv_record, wanted)
    return True


def repair(layout: Layout) -> None:
    """Put this machine's paths into the CMake files of the wheels."""
    site_packages = next(layout.venv.glob("lib/python3.*/site-packages"))
    numpy_include = site_packages / "numpy" / "_core" / "include"
    if not numpy_include.is_dir():
        raise SetupProblem(f"{numpy_include} is missing: run 'make clean' and then 'make build'")
    repair_prefix(layout.venv, sysconfig.get_path("include"), str(numpy_include))


def _running_python() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor} of {sys.base_prefix}"


def _make_venv(layout: Layout, env: Mapping[str, str], options: Sequence[str]) -> None:
    log = layout.logs / "venv.log"
    base_python = str(getattr(sys, "_base_executable", sys.executable))
    command = [base_python, "-m", "venv", *options, str(layout.venv)]
    if not run_step("making a virtual environment", command, log, env, layout.root):
        shutil.rmtree(layout.venv, ignore_errors=True)
        raise SetupProblem(f"making the virtual environment failed: {_last_line(log)} ({log})")
    # The wheels bring package.xml files, which a 'colcon build' by hand would take for sources.
    (layout.venv / "COLCON_IGNORE").touch()


def _pip_install(
    layout: Layout, what: Sequence[str], title: str, env: Mapping[str, str]
) -> None:
    log = layout.logs / "pip.log"
    pip_env = dict(env)
    pip_env.setdefault("PIP_DEFAULT_TIMEOUT", "60")
    pip_env.setdefault("PIP_RETRIES", "5")
    pip_env.update(PIP_USER="0", PIP_DISABLE_PIP_VERSION_CHECK="1", PIP_NO_INPUT="1")
    command = [str(layout.venv_python), "-m", "pip", "install", "--progress-bar", "off", *what]
    if not run_step(title, command, log, pip_env, layout.root):
        raise SetupProblem(explain_pip_failure(log.read_text(errors="replace"), log))


def explain_pip_failure(output: str, log: Path) -> str:
    """One line on why pip failed, from its output."""
    if _NO_SPACE.search(output):
        return f"the disk is full: free 2 GB and run this again (log: {log})"
    if _NETWORK.search(output):
        return (
            "the Python package registry cannot be reached: check the network (or the proxy and "
            f"index that pip is set to) and run this again (log: {log})"
        )
    errors = [line for line in output.splitlines() if line.startswith("ERROR:")]
    reason = errors[0].removeprefix("ERROR:").strip() if errors else "no reason given"
    return f"pip could not install the wheels: {reason} (log: {log})"


def _missing_requirements(
    layout: Layout, requirements: Path, env: Mapping[str, str]
) -> list[str]:
    """Requirements of a file whose module, named in the comment behind it, cannot be imported."""
    missing = []
    for line in requirements.read_text(encoding="utf-8").splitlines():
        requirement, _, module = (part.strip() for part in line.partition("# import "))
        if requirement and module and not _imports(layout, module, env):
            missing.append(requirement)
    return missing


def _imports(layout: Layout, module: str, env: Mapping[str, str]) -> bool:
    command = [str(layout.venv_python), "-c", f"import {module}"]
    return subprocess.run(command, env=dict(env), capture_output=True, check=False).returncode == 0


def _installed_numpy(layout: Layout, env: Mapping[str, str]) -> str:
    command = [str(layout.venv_python), "-c", "import numpy; print('numpy==' + numpy.__version__)"]
    found = subprocess.run(command, env=dict(env), capture_output=True, text=True, check=False)
    return found.stdout


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "no output"
