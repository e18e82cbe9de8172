#!/usr/bin/env python3
"""Force from the displacement of the markers: errors by load case, against a known truth.

--quick prints the load cases at 10 N and 1 N alone.
"""

from __future__ import annotations

import argparse
import sys
from time import perf_counter

from force_cases import load_cases
from force_quick import case_lines

from cmp_tactile_processing.force import ForceModel
from cmp_tactile_processing.sensor_library import load_sensor


def parser() -> argparse.ArgumentParser:
    """The command line."""
    given = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    given.add_argument("--quick", action="store_true", help="the load cases at 10 N and 1 N")
    given.add_argument("--oracle", action="store_true", help="with --quick: the best possible too")
    given.add_argument("--frames", type=int, default=20, help="frames of noise (%(default)s)")
    given.add_argument("--sensor", default="sample_rig", help="name or file (%(default)s)")
    return given


def main() -> int:
    """Measure what the options ask for; 1 where a limit is missed."""
    arguments = parser().parse_args()
    sensor = load_sensor(arguments.sensor)
    began = perf_counter()
    model, cases = ForceModel(sensor), load_cases(sensor)
    print(f"model and cases ready in {perf_counter() - began:.1f} s")
    missed = 0
    for line in case_lines(model, cases, arguments.frames, arguments.oracle):
        missed += "MISS" in line
        print(line, flush=True)
    print(f"{missed} cases miss a limit, {perf_counter() - began:.0f} s")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
