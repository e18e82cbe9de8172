"""Makes what frames of a sensor need before the first of them: compiled code and elastic model.

`python3 -m cmp_tactile_processing.prepare NAME [--only PART ...]` does so in a process of its own.
With `--install PREFIX` the compiled code goes below the prefix that the packages are installed in,
for all users, with that of the simulator where it is there.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import subprocess
import sys
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path

from cmp_tactile_processing.cache.compiled import installing, when_compiling
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.processes import OnProgress, no_progress, python_command
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper
from cmp_tactile_processing.tracking.tracker import GridTracker

TRACKING = ("trackers", "stereo")
PARTS = (*TRACKING, "forces")
"""Compiled side by side when the packages are installed."""


def prepare(
    sensor: SensorDescription, parts: Collection[str] = PARTS, progress: OnProgress = no_progress
) -> None:
    """Compile what frames need, and build and cache the elastic model, where that is not done yet.

    It makes the stages, each of which is ready for frames when it is made.  Compiled code is the
    same for most sensors.  parts: of PARTS.  progress: called with what is compiled or built.
    """
    with when_compiling(progress):
        for view in sensor.views if "trackers" in parts else ():
            GridTracker(sensor, view)
        if "stereo" in parts:
            if sensor.views:
                StereoRig(sensor)
            ReferenceKeeper(Reference.nominal(sensor))
        if "forces" in parts:
            ForceStage(sensor, progress=progress)


def main(arguments: Sequence[str]) -> int:
    """Prepare a sensor, by name or path; the exit code."""
    parser = argparse.ArgumentParser(prog="prepare")
    parser.add_argument("sensor")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, help="some of the parts")
    parser.add_argument("--install", metavar="PREFIX", type=Path, help="compile for all users")
    options = parser.parse_args(arguments)
    try:
        if options.install is not None:
            return _install(options.sensor, options.install)
        prepare(load_sensor(options.sensor), options.only)
    except CmpTactileError as error:
        sys.stderr.write(f"prepare: {error}\n")
        return 1
    return 0


def _install(sensor: str, prefix: Path) -> int:
    """Compile all parts side by side for the packages below this prefix; the exit code."""
    command = python_command("cmp_tactile_processing.prepare", sensor, "--only")
    commands = [[*command, part] for part in PARTS]
    if importlib.util.find_spec("cmp_tactile_simulation"):
        commands.append(python_command("cmp_tactile_simulation.prepare"))
    # By an exception, which ends the other processes, too.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        with installing(prefix) as folder, ExitStack() as stack:
            env = {**os.environ, "NUMBA_CACHE_DIR": str(folder)}
            processes = []
            for item in commands:
                processes.append(subprocess.Popen(item, env=env))
                stack.callback(processes[-1].terminate)
            codes = [process.wait() for process in processes]
            if any(codes):
                msg = f"{prefix}: nothing is installed, because a part could not be compiled"
                raise CmpTactileError(msg)
    except OSError as error:
        msg = f"{prefix}: cannot be written: {error}"
        raise CmpTactileError(msg) from None
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
