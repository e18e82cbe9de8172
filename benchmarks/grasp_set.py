#!/usr/bin/env python3
"""Time and memory of a whole data set: the packaged scene grasp_long, 1,000 frames with truth.

`cmp_tactile simulate` solves, renders and writes at the same time; the peer is the same work of one
grasp (100 frames), one after the other. With --frames N only the first N frames are simulated and
the whole is extrapolated from them; N should be a multiple of 100, since frames without contact are
cheaper. With its defaults this takes about ten minutes.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from cmp_tactile_simulation.recording.run import RunOptions, run_scene
from cmp_tactile_simulation.recording.writer import RecordingWriter
from cmp_tactile_simulation.scenes.description import Scene
from cmp_tactile_simulation.scenes.library import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

SCENE = "grasp_long"
ONE_GRASP = 100
GOAL_S, GOAL_BYTES = 600.0, 4e9


def at_once(scene: Scene, frames: int, folder: Path) -> tuple[float, int]:
    """Seconds and bytes of a recording."""
    start = perf_counter()
    run_scene(scene, folder, RunOptions(frames=frames))
    return perf_counter() - start, (folder / f"{folder.name}.mcap").stat().st_size


def one_after_the_other(scene: Scene, frames: int, folder: Path) -> dict[str, float]:
    """Seconds of solving, rendering (with the truth) and writing."""
    simulation = Simulation(scene)
    writer = RecordingWriter(folder, scene.sensor)
    seconds = dict.fromkeys(("solving", "rendering", "writing"), 0.0)
    state = simulation.start()
    moved = simulation.elastomer.marker_displacement(state.contact.force)
    states = simulation.states(state)
    for _ in range(frames):
        start = perf_counter()
        state = next(states)
        before, moved = moved, simulation.elastomer.marker_displacement(state.contact.force)
        solved = perf_counter()
        frame = simulation.observe(state, before, moved)
        rendered = perf_counter()
        writer.append(frame)
        written = perf_counter()
        seconds["solving"] += solved - start
        seconds["rendering"] += rendered - solved
        seconds["writing"] += written - rendered
    writer.close()
    return seconds


def main() -> int:
    """Measure and print a table; 1 where a goal is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, help="simulate only the first N and extrapolate")
    arguments = parser.parse_args()
    scene = load_scene(SCENE)
    count = min(arguments.frames or scene.frame_count, scene.frame_count)
    Simulation(scene)  # the gel's compliance is kept on disk and not counted
    with tempfile.TemporaryDirectory() as folder:
        seconds, size = at_once(scene, count, Path(folder) / "set")
        peer = min(count, ONE_GRASP)
        apart = one_after_the_other(scene, peer, Path(folder) / "peer")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    frame, frame_apart = seconds / count, sum(apart.values()) / peer
    whole = frame * scene.frame_count
    how = "measured" if count == scene.frame_count else f"extrapolated from the first {count}"
    print(f"{'':40s} {'':>12s}  ratio")
    print(f"{'a frame, at the same time':40s} {frame:10.3f} s  {frame / frame_apart:5.2f}")
    print(f"{'a frame, one after the other':40s} {frame_apart:10.3f} s   1.00")
    for name, part in apart.items():
        print(f"{'  ' + name:40s} {part / peer:10.3f} s  {part / peer / frame_apart:5.2f}")
    label = f"{scene.frame_count} frames ({how})"
    print(f"{label:40s} {whole:10.1f} s  {whole / GOAL_S:5.2f} of 600 s")
    print(f"{'peak memory':40s} {peak / 1e9:9.2f} GB  {peak / GOAL_BYTES:5.2f} of 4 GB")
    print(f"{'recording, a frame':40s} {size / count / 1e3:9.0f} kB")
    return int(whole > GOAL_S or peak > GOAL_BYTES)


if __name__ == "__main__":
    sys.exit(main())
