#!/usr/bin/env python3
"""Processor time of a sample of a dataset, its parts, and how it scales with processes.

    setup/run python3 benchmarks/dataset.py --recipe presses --count 64

Ratios are to OpenCV's classic detector with cornerSubPix on both views of the same samples.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
from tables import CommandLine, head, line
from tracking.detectors import peers

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_simulation.dataset.recipe import load_recipe
from cmp_tactile_simulation.dataset.sampling import Sampler, draw
from cmp_tactile_simulation.dataset.shards import write_samples
from cmp_tactile_simulation.simulator import Simulator

CONTACT, RENDERING, WRITING = "contact", "rendering and truth", "writing"
WARM_UP = 3


class Parts:
    """Processor times by part, s."""

    def __init__(self) -> None:
        self.times: Counter[str] = Counter()

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add what is done to a part."""
        begin = time.process_time()
        yield
        self.times[name] += time.process_time() - begin

    def wrap(self, owner: type[Any], method: str, name: str) -> None:
        """Time a method of a class."""
        plain: Callable[..., Any] = getattr(owner, method)

        def timed(*given: Any, **named: Any) -> Any:
            with self.timed(name):
                return plain(*given, **named)

        setattr(owner, method, timed)


def one_process(name: str, count: int) -> None:
    """Times of the parts of a sample, and of OpenCV's detector on it."""
    recipe, parts = load_recipe(name), Parts()
    sampler, opencv = Sampler(recipe), peers()[0]
    for number in range(WARM_UP):
        sampler.frames(draw(recipe, number))
    parts.wrap(Simulator, "observe", RENDERING)
    made = []
    begin = time.process_time()
    for number in range(WARM_UP, WARM_UP + count):
        sample = draw(recipe, number)
        try:
            made.append((sample, sampler.frames(sample)))
        except CmpTactileError as error:
            print(f"sample {number}: {error}")
    parts.times[CONTACT] = time.process_time() - begin - parts.times[RENDERING]
    with tempfile.TemporaryDirectory() as folder, parts.timed(WRITING):
        write_samples(Path(folder, "samples.nc"), recipe, made)
    found = 0.0
    frames = [frame for _, several in made for frame in several]
    for frame in frames:
        for view, grid in frame.grids.items():
            image = split_frame(frame.image, grid.placement)
            found += opencv.detect(recipe.sensor, view, image, grid).seconds
    print(head("part", "processor time of a frame, ms", "divided by OpenCV's"))
    total = sum(parts.times.values())
    for part, taken in [*parts.times.items(), ("all", total)]:
        print(line(part, f"{1e3 * taken / len(frames):.0f}", f"{taken / found:.1f}"))
    print(f"\nOpenCV's detector: {1e3 * found / len(frames):.1f} ms a frame")


def by_processes(name: str, count: int, most: int) -> None:
    """Samples a second of `cmp_tactile dataset`, by the clock, start and compiled code included."""
    print(f"\n{head('processes', 'samples a second')}")
    for processes in range(1, most + 1):
        with tempfile.TemporaryDirectory() as folder:
            command = ["cmp_tactile", "dataset", name, "--samples", str(count), "-o", f"{folder}/d"]
            begin = time.monotonic()
            subprocess.run([*command, "--jobs", str(processes)], check=True, capture_output=True)
            print(line(processes, f"{count / (time.monotonic() - begin):.1f}"))


def main() -> None:
    """Run from the command line."""
    parser = CommandLine(__doc__)
    parser.option("--recipe", "a recipe", "presses")
    parser.option("--count", "samples", 64)
    parser.option("--jobs", "most processes", os.cpu_count() or 1)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    one_process(arguments.recipe, arguments.count)
    by_processes(arguments.recipe, 4 * arguments.count, arguments.jobs)


if __name__ == "__main__":
    main()
