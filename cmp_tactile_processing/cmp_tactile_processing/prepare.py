"""Makes what frames of a sensor need before the first of them: compiled code and elastic model.

`python3 -m cmp_tactile_processing.prepare NAME [--only PART ...]` does so in a process of its own.
It writes "compiling" on stdout as soon as there is something to compile.  With `--install PREFIX`
the compiled code goes below the prefix that the packages are installed in, for all users.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from cmp_tactile_processing.cache.compiled import installing, when_compiling
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.processes import OnProgress, python_command
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper
from cmp_tactile_processing.tracking.tracker import GridTracker


def prepare_tracking(sensor: SensorDescription) -> None:
    """Compile what finds gridlines, points and surface; it is the same for most sensors."""
    _prepare_trackers(sensor)
    _prepare_stereo(sensor)


def _prepare_trackers(sensor: SensorDescription) -> None:
    for view in sensor.views:
        GridTracker(sensor, view)


def _prepare_stereo(sensor: SensorDescription) -> None:
    if sensor.views:
        StereoRig(sensor)
    ReferenceKeeper(Reference.nominal(sensor))


def prepare_forces(sensor: SensorDescription, progress: OnProgress | None = None) -> None:
    """Compile what finds forces, and build and cache the elastic model.

    progress: called with what is built of a model that is not cached, and its share.
    """
    ForceStage(sensor, progress=progress)


# Compiled side by side when the packages are installed.
PARTS = {"trackers": _prepare_trackers, "stereo": _prepare_stereo, "forces": prepare_forces}


def main(arguments: Sequence[str]) -> int:
    """Prepare a sensor, by name or path; the exit code."""
    parser = argparse.ArgumentParser(prog="prepare")
    parser.add_argument("sensor")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="some of the parts")
    parser.add_argument("--install", metavar="PREFIX", type=Path, help="compile for all users")
    options = parser.parse_args(arguments)
    try:
        if options.install is not None:
            return _install(options.sensor, options.install)
        sensor = load_sensor(options.sensor)
        with when_compiling(_report):
            for part in options.only or PARTS:
                PARTS[part](sensor)
    except CmpTactileError as error:
        sys.stderr.write(f"prepare: {error}\n")
        return 1
    return 0


def _install(sensor: str, prefix: Path) -> int:
    """Compile all parts side by side for the packages below this prefix; the exit code."""
    command = python_command("cmp_tactile_processing.prepare", sensor, "--only")
    # By an exception, which ends the other processes, too.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with installing(prefix) as folder, ExitStack() as stack:
            env = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
            processes = []
            for part in PARTS:
                processes.append(subprocess.Popen([*command, part], env=env))
                stack.callback(processes[-1].terminate)
            codes = [process.wait() for process in processes]
            if any(codes):
                msg = f"{prefix}: nothing is installed, because a part could not be compiled"
                raise CmpTactileError(msg)
    except OSError as error:
        msg = f"{prefix}: cannot be written: {error}"
        raise CmpTactileError(msg) from None
    return 0


def _report() -> None:
    sys.stdout.write("compiling\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
