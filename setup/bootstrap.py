#!/usr/bin/env python3
"""Makes a checkout ready to use: ROS 2 (from wheels where none is sourced) and a built workspace.

Run it as often as you like: it does what is missing or has changed, and nothing else.
"""

from __future__ import annotations

import fcntl
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cmp_tactile_setup import environment, machine, virtual_environment, workspace
from cmp_tactile_setup.layout import Layout
from cmp_tactile_setup.problem import SetupProblem
from cmp_tactile_setup.progress import say
from cmp_tactile_setup.record import read_record
from cmp_tactile_setup.ros_installation import RosInstallation, sourced_ros


def prepare(layout: Layout) -> None:
    """Bring the checkout up to date. Raises SetupProblem."""
    machine.check_checkout_path(layout.root)
    for record in (layout.venv_record, layout.build_record):
        machine.check_not_moved(layout.root, read_record(record).get("root"))
    ros = sourced_ros(os.environ, layout.root)
    if ros is None and not machine.supported_python(sys.version_info[:2]):
        _restart_with_another_python()
    with _only_one(layout.lock):
        _bring_up_to_date(layout, ros)


def _bring_up_to_date(layout: Layout, ros: RosInstallation | None) -> None:
    with_ros = ros is not None
    clean = environment.clean_environment(os.environ, with_ros)
    packages = workspace.packages_to_build(layout, ros)
    if ros is None:
        flavour = "kilted wheels"
        _check_machine()
        changed = virtual_environment.ensure_wheels(layout, clean)
    else:
        flavour = f"ROS 2 {ros.distro} at {':'.join(str(prefix) for prefix in ros.prefixes)}"
        machine.check_build_tools()
        machine.check_venv()
        changed = virtual_environment.ensure_missing_libraries(layout, clean)
    if changed:
        workspace.forget(layout)
    env = environment.build_environment(layout, clean, with_ros)
    built = workspace.ensure_built(layout, packages, flavour, env)
    if built or not layout.environment_file.exists():
        environment.write_environment_file(layout, env, with_ros)
        say("ready; '. setup/env.sh' gives you the environment, 'make help' the commands")


def _check_machine() -> None:
    machine.check_platform()
    machine.check_venv()
    machine.check_python_headers()
    machine.check_build_tools()


def _restart_with_another_python() -> None:
    other = machine.other_supported_python()
    if other is None:
        machine.check_python(sys.version_info[:2])
    else:
        os.execv(other, [other, *sys.argv])


@contextmanager
def _only_one(lock: Path) -> Iterator[None]:
    """Hold the lock of this checkout; wait while another set-up has it."""
    with lock.open("w") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up of this checkout is running, waiting for it")
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


def main() -> int:
    """Prepare the checkout that this file lies in; 0, or 1 after one line on what is wrong."""
    layout = Layout(Path(__file__).resolve().parent.parent)
    try:
        prepare(layout)
    except SetupProblem as problem:
        print(f"set-up: {problem}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nset-up: interrupted; the same command goes on from here", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"set-up: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
