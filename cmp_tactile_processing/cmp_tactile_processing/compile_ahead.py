"""Compiles what the frames need: `python3 -m cmp_tactile_processing.compile_ahead NAME`.

Writes "compiling" on stdout as soon as there is something to compile.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cmp_tactile_processing.cache.compiled import when_compiling
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.dense import SurfaceInterpolator
from cmp_tactile_processing.tracking.tracker import GridTracker

__all__ = ["main"]


def main(arguments: Sequence[str]) -> int:
    """Build the stages of a sensor, by name or path; compiled code is the same for all."""
    try:
        sensor = load_sensor(*arguments)
        with when_compiling(_report):
            _build(sensor)
    except (CmpTactileError, TypeError) as error:
        sys.stderr.write(f"compile_ahead: {error}\n")
        return 1
    return 0


def _build(sensor: SensorDescription) -> None:
    for view in sensor.views:
        GridTracker(sensor, view)
    StereoRig(sensor)
    pattern = sensor.pattern
    cell = SurfaceGrid(2, 2, (pattern.pitch, pattern.pitch))
    SurfaceInterpolator(pattern.shape, pattern.pitch, cell)


def _report() -> None:
    sys.stdout.write("compiling\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
