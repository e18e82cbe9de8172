#!/usr/bin/env python3
"""Compare gridline tracking with other detectors: corners found, their errors, time.

Frames are patterns deformed by hand, rendered with exact truth. With --data or
CMP_TACTILE_SAMPLE_DATA, frames of a folder are added. Each view is a separate image, and OpenCV has
one thread. Without options, all cases, all sweeps and the steady state are measured (about a
quarter of an hour).
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).parents[1]))
import cv2
from detectors import ours, peers
from limits import TrackingLimits
from sweeps import SWEEPS, Point, SweepRun, write_markdown
from tables import CommandLine, missed

from cmp_tactile_processing.sensor.description import load_sensor

SENSOR = "sample_rig"
OUTPUT = Path("benchmark_output")
DATA_VARIABLE = "CMP_TACTILE_SAMPLE_DATA"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    given = CommandLine(__doc__)
    given.option("--detector", "our detector for --limits", "saddle_lattice")
    given.option("--seed", "seed of the cases", 0)
    given.option("--seeds", "number of seeds", 1)
    parts = TrackingLimits.PARTS
    text = "print a row for each limit of these parts (default: all): limit, measured, met"
    given.option("--limits", text, nargs="*", choices=parts, metavar="PART")
    given.option("--sweep", "only sweeps with this in their name; repeatable", action="append")
    given.option("--peer-images", "views of each level for a peer", 6)
    given.option("--peer-seconds", "time of a peer for a sweep", 60.0)
    given.option("--output", "folder for the tables", OUTPUT, type=Path)
    data = os.environ.get(DATA_VARIABLE)
    given.option("--data", f"folder of sample frames, or ${DATA_VARIABLE}", data)
    return given


def sweeps(arguments: argparse.Namespace) -> None:
    """All sweeps, ours against the peers: tables."""
    detectors = [*ours(), *peers()]
    versions = [f"{detector.name}: {detector.version}" for detector in detectors]
    caps = (
        f"Peers get at most {arguments.peer_images} views of a level and "
        f"{arguments.peer_seconds:g} s for a sweep"
    )
    notes: list[str] = []

    def note(text: str) -> None:
        notes.append(text)
        print(text, flush=True)

    for text in (*versions, caps):
        note(text)
    run = SweepRun(
        load_sensor(SENSOR), detectors, arguments.peer_images, arguments.peer_seconds, note
    )
    arguments.output.mkdir(parents=True, exist_ok=True)
    points: list[Point] = []
    wanted = arguments.sweep or [""]
    chosen = [sweep for sweep in SWEEPS if any(text in sweep.name for text in wanted)]
    if not chosen:
        names = ", ".join(sweep.name for sweep in SWEEPS)
        sys.exit(f"--sweep: found {' '.join(wanted)!r}, expected a part of one of: {names}")
    for sweep in chosen:
        began = perf_counter()
        points += list(run.points(sweep))
        print(f"{sweep.name}: {perf_counter() - began:.0f} s", flush=True)
        # After each: an interrupted run leaves what it has.
        write_markdown(points, notes, arguments.output / "extraction.md")
    print((arguments.output / "extraction.md").read_text())


def main() -> int:
    """Measure what the options ask for."""
    arguments = parser().parse_args()
    cv2.setNumThreads(1)
    if arguments.limits is not None:
        run = TrackingLimits(
            load_sensor(SENSOR),
            Path(arguments.data) if arguments.data else None,
            range(arguments.seed, arguments.seed + arguments.seeds),
            arguments.detector,
        )
        return int(missed(run.show(arguments.limits)) > 0)
    sweeps(arguments)
    return 0


if __name__ == "__main__":
    sys.exit(main())
