"""Makes a checkout ready to use: a virtual environment and a built workspace."""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from cmp_tactile_setup import machine, steps, virtual_environment, workspace
from cmp_tactile_setup.layout import (
    Layout,
    build_environment,
    chosen_distribution,
    clean_environment,
    write_environment_file,
)

COMPILED = "cmp_tactile_processing"
# Its sources count for the folder of the cache.
COMPILED_TOO = "cmp_tactile_simulation"


def prepare(layout: Layout) -> None:
    """Bring the checkout up to date for the layout's distribution. Raises SetupError."""
    for record in (layout.venv_record, layout.build_record):
        machine.check_not_moved(layout.root, steps.read_record(record).get("root"))
    with _only_one(layout.lock):
        venv_is_current = virtual_environment.is_current(layout)
        if venv_is_current and workspace.is_current(layout):
            return
        clean = clean_environment(os.environ, layout)
        if not venv_is_current:
            _prepare_venv(layout, clean)
        _build(layout, build_environment(layout, clean))
    steps.say("ready: 'make help' lists the commands, '. setup/env.sh' gives you a shell for ROS 2")


def _prepare_venv(layout: Layout, env: Mapping[str, str]) -> None:
    if not virtual_environment.needs_another(layout):
        virtual_environment.update_wheels(layout, env)
        return
    if layout.ros is None:
        machine.check_platform()
        if better := machine.better_python(layout.distro):
            os.execv(better, [better, *sys.argv])  # noqa: S606
    machine.check_tools(for_venv=True, for_wheels=layout.ros is None)
    if layout.ros is None:
        virtual_environment.make_from_wheels(layout, env)
    else:
        virtual_environment.make_beside_ros(layout, layout.ros, env)


def _build(layout: Layout, env: Mapping[str, str]) -> None:
    machine.check_tools(for_venv=False, for_wheels=False)
    workspace.clear_outdated(layout)
    with compiling_beside(layout, env):
        workspace.build(layout, env)
        write_environment_file(layout, env)
        workspace.record_finished(layout)


@contextmanager
def compiling_beside(layout: Layout, env: Mapping[str, str]) -> Iterator[None]:
    """Compile trackers and forces into the installed packages, while these are built.

    Each user's first start of the software would do it otherwise. Where it fails, that does it and
    says why.
    """
    sources = [str(layout.root / name) for name in (COMPILED, COMPILED_TOO)]
    paths = [*sources, *filter(None, [env.get("PYTHONPATH")])]
    prefix = str(layout.install / COMPILED)
    module = f"{COMPILED}.prepare"
    command = [str(layout.venv_python), "-m", module, "sample_rig", "--install", prefix]
    changed = {**env, "PYTHONPATH": os.pathsep.join(paths)}
    log = layout.logs / "compile.log"
    with steps.started_command(command, log, changed, layout.root) as process:
        yield
        if not steps.wait_for_step("compiling what finds gridlines and forces", process):
            steps.say(f"the first start of the software will compile it (log: {log})")


@contextmanager
def _only_one(lock: Path) -> Iterator[None]:
    """Hold the lock of this checkout; wait while another set-up has it."""
    with lock.open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            steps.say("waiting: another set-up of this checkout is running")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def main(script: str) -> int:
    """Prepare the checkout that has the script in its `setup/`.

    Returns the exit status: 0, or another after one line on what is wrong.
    """
    root = Path(script).resolve().parent.parent
    try:
        machine.check_checkout_path(root)
        ros = machine.sourced_ros(os.environ, root)
        prepare(Layout(root, chosen_distribution(os.environ.get("CMP_TACTILE_ROS", ""), ros), ros))
    except steps.SetupError as error:
        print(f"set-up: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nset-up: interrupted; run the same command again to continue", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"set-up: {error}", file=sys.stderr)
        return 1
    return 0
