"""The virtual environment of a checkout: the wheels of ROS 2, or what a ROS 2 machine lacks."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from cmp_tactile_setup import steps
from cmp_tactile_setup.layout import Layout
from cmp_tactile_setup.machine import RosInstallation

_INCLUDE_FOLDERS = """
import json, numpy, sysconfig
print(json.dumps([sysconfig.get_path("include"), numpy.get_include()]))
"""
# Only what is locked is installed, and only as wheels: to install them runs nothing of theirs.
# The lock is complete, so nothing is resolved: what a registry serves that day changes nothing.
# The one library that has no wheel is built with the locked setuptools, not with a newer one.
AS_LOCKED = (
    *("--require-hashes", "--no-deps"),
    *("--only-binary", ":all:", "--no-binary", "empy"),
    "--no-build-isolation",
)
# uv reads no settings of pip, which name the registry on many machines.
_UV_VARIABLES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "cert": "SSL_CERT_FILE",
    "proxy": "ALL_PROXY",
}
_PYTHON_INCLUDE = re.compile(r"/opt/python/[^/;\"]+/include/python3\.\d+")
_NUMPY_INCLUDE = re.compile(
    r"/opt/python/[^/;\"]+/lib/python3\.\d+/site-packages/numpy/_core/include"
)
_TINYXML2 = re.compile(r"/usr/lib64/libtinyxml2\.so")


def is_current(layout: Layout) -> bool:
    """Whether the virtual environment is complete and what this checkout wants.

    The interpreter that it was made with may be another than the running one, but must still be
    there: an upgrade of the system can have put a newer one in its place.
    """
    record = steps.read_record(layout.venv_record)
    return record == _record(layout) and layout.venv_python.exists()


def needs_another(layout: Layout) -> bool:
    """Whether the environment must be made again, rather than only be given other libraries."""
    if layout.ros is not None or not layout.venv_python.exists():
        return True
    recorded = steps.read_record(layout.venv_record)
    wanted = _record(layout)
    kept = wanted.keys() - {"requirements"}
    return any(recorded.get(key) != wanted[key] for key in kept)


def make_from_wheels(layout: Layout, env: Mapping[str, str]) -> None:
    """Make the virtual environment with ROS 2 and all libraries, from the start."""
    python = sys.version.split()[0]
    title = layout.distro.capitalize()
    steps.say(f"ROS 2 {title} from wheels into {layout.venv.name}, once (Python {python}, 1 GB)")
    _make_venv(layout, env, [])
    update_wheels(layout, env)


def update_wheels(layout: Layout, env: Mapping[str, str]) -> None:
    """Bring the libraries in the virtual environment to the required versions."""
    # An update that is interrupted leaves no record, so that the next one starts again.
    layout.venv_record.unlink(missing_ok=True)
    build_tools, wheels = ([*AS_LOCKED, "-r", str(path)] for path in _requirements(layout))
    _pip_install(layout, ["--use-pep517", *build_tools], "installing the build tools", env)
    # uv takes a sixth of pip's time. Where it fails, pip has the last word and says why.
    if not _uv_install(layout, wheels, "installing wheels", env):
        _pip_install(layout, ["--use-pep517", *wheels], "installing wheels with pip", env)
    folders = _output_of(layout, ["-c", _INCLUDE_FOLDERS], env)
    if folders is None:
        raise steps.SetupError(
            f"numpy in {layout.venv} does not work: run 'make clean' and try again"
        )
    repair_prefix(layout.venv, *json.loads(folders))
    steps.write_record(layout.venv_record, _record(layout))


def make_beside_ros(layout: Layout, ros: RosInstallation, env: Mapping[str, str]) -> None:
    """Make the virtual environment on top of the system's Python, with the libraries it lacks.

    Libraries that the system has are used as they are, because ROS 2 was compiled against them.
    """
    steps.say(f"libraries that ROS 2 {ros.distro} does not bring into {layout.venv.name}, once")
    _make_venv(layout, env, ["--system-site-packages"])
    missing = [
        requirement
        for path in _requirements(layout)
        for requirement, module in read_requirements(path)
        if _output_of(layout, ["-c", f"import {module}"], env) is None
    ]
    if missing:
        constraints = layout.venv / "constraints.txt"
        print_numpy = "import numpy; print('numpy==' + numpy.__version__)"
        numpy = _output_of(layout, ["-c", print_numpy], env)
        constraints.write_text(numpy or "", encoding="utf-8")
        title = f"installing {len(missing)} libraries"
        _pip_install(layout, ["-c", str(constraints), *missing], title, env)
    steps.write_record(layout.venv_record, _record(layout))


def read_requirements(path: Path) -> list[tuple[str, str]]:
    """Each requirement of a file with the module that the comment behind it names."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        requirement, separator, module = line.partition("# import ")
        if separator:
            found.append((requirement.strip(), module.strip()))
    return found


def _requirements(layout: Layout) -> list[Path]:
    if layout.ros is not None:
        return [layout.requirements("requirements-with-ros.txt")]
    names = ("locked-build.txt", f"locked-{layout.distro}.txt")
    return [layout.requirements(name) for name in names]


def _record(layout: Layout) -> dict[str, str]:
    return {
        "root": str(layout.root),
        "python": str(layout.venv_python.resolve()),
        "requirements": steps.digest(_requirements(layout), [], layout.root),
        "ros": "wheels" if layout.ros is None else layout.ros.distro,
    }


def _make_venv(layout: Layout, env: Mapping[str, str], options: Sequence[str]) -> None:
    """Make the virtual environment again: one without a valid record may be half of one."""
    log = layout.logs / "venv.log"
    # Run from inside a virtual environment, the interpreter below it is the lasting one.
    base_python = str(getattr(sys, "_base_executable", sys.executable))
    command = [base_python, "-m", "venv", "--clear", *options, str(layout.venv)]
    if not steps.run_step("making a virtual environment", command, log, env, layout.root):
        shutil.rmtree(layout.venv, ignore_errors=True)
        raise steps.failure("making a virtual environment", log)
    # The wheels bring package.xml files, which a 'colcon build' by hand would take for sources.
    (layout.venv / "COLCON_IGNORE").touch()


def _uv_install(layout: Layout, what: Sequence[str], title: str, env: Mapping[str, str]) -> bool:
    """Install with uv, from the registry that pip is set to; True if it succeeds."""
    command = [str(layout.venv_python), "-m", "uv", "pip", "install", *what]
    uv_env = {
        **uv_variables(_output_of(layout, ["-m", "pip", "config", "list"], env) or ""),
        # A hash is what makes a file the right one, not the index that has it.
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        **env,
        "VIRTUAL_ENV": str(layout.venv),
    }
    return steps.run_step(title, command, layout.logs / "uv.log", uv_env, layout.root)


def uv_variables(pip_settings: str) -> dict[str, str]:
    """Settings of pip, as `pip config list` prints them, as variables of uv."""
    found = {}
    # From the weakest to the strongest, as pip takes them.
    for section in ("global", "install", ":env:"):
        for name, text in re.findall(rf"^{section}\.([\w-]+)='(.*)'$", pip_settings, re.MULTILINE):
            if name in _UV_VARIABLES:
                separator = "," if name == "find-links" else " "
                found[_UV_VARIABLES[name]] = separator.join(text.replace("\\n", " ").split())
    return found


def _pip_install(layout: Layout, what: Sequence[str], title: str, env: Mapping[str, str]) -> None:
    log = layout.logs / "pip.log"
    pip_env = {"PIP_DEFAULT_TIMEOUT": "60", "PIP_RETRIES": "5", **env}
    pip_env.update(PIP_USER="0", PIP_DISABLE_PIP_VERSION_CHECK="1", PIP_NO_INPUT="1")
    # Most of 8,000 modules are never imported; Python compiles a module at its first import.
    options = ("--no-compile", "--progress-bar", "off")
    command = [str(layout.venv_python), "-m", "pip", "install", *options, *what]
    if not steps.run_step(title, command, log, pip_env, layout.root):
        raise steps.failure(title, log)


def _output_of(layout: Layout, arguments: Sequence[str], env: Mapping[str, str]) -> str | None:
    """What the environment's Python prints with these arguments, or None if it fails."""
    command = [str(layout.venv_python), *arguments]
    done = subprocess.run(
        # Python takes modules from the current folder first.
        command,
        cwd=layout.root,
        env=dict(env),
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout if done.returncode == 0 else None


def repair_prefix(prefix: Path, python_include: str, numpy_include: str) -> list[Path]:
    """Replace the build machine's paths in `share/*/cmake/*.cmake` below `prefix` by this one's.

    Returns the files that were changed.
    A second call changes nothing. Each file is replaced in one step, so that an interruption
    leaves the old or the new file, never half of one.
    """
    # The library as the wheel bundles it, or its bare name for the linker to find.
    tinyxml2 = sorted(prefix.glob("lib/python3.*/site-packages/*.libs/libtinyxml2*.so*"))
    here = {
        _NUMPY_INCLUDE: numpy_include,
        _PYTHON_INCLUDE: python_include,
        _TINYXML2: str(tinyxml2[0]) if tinyxml2 else "tinyxml2",
    }
    changed = []
    for path in sorted(prefix.glob("share/*/cmake/*.cmake")):
        before = after = path.read_text(encoding="utf-8")
        for built_at, place in here.items():
            after = built_at.sub(place.replace("\\", r"\\"), after)
        if after != before:
            steps.replace_file(path, after)
            changed.append(path)
    return changed
