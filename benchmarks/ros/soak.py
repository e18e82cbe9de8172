"""A long run of one container: memory, file handles, threads and latency must not grow.

setup/run python3 benchmarks/ros/soak.py [--frames 100000] [--rate 60]

The same container and listener as in real_time.py.  Prints a row for each part of the run as it
goes, and at the end the growth from the second part to the last; exits with 1 where it is more than
allowed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from real_time import Wrenches, busy_s, container, spin_until

PARTS = 20
# Between the second part and the last.  Memory: what the allocator and DDS's histories settle by.
MAX_GROWTH = {"memory_mb": 20.0, "handles": 4, "threads": 4}
MAX_LATENCY_FACTOR = 1.25


@dataclass(frozen=True)
class Footprint:
    """What a process holds."""

    memory_mb: float
    handles: int
    threads: int

    @classmethod
    def from_process(cls, pid: int) -> Footprint:
        """Of a process that runs."""
        text = Path(f"/proc/{pid}/status").read_text()
        status = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
        memory = int(status["VmRSS"].split()[0]) / 1024
        handles = len(list(Path(f"/proc/{pid}/fd").iterdir()))
        return cls(memory, handles, int(status["Threads"]))

    def grown(self, early: Footprint, limits: Mapping[str, float]) -> list[str]:
        """What is larger than it was by more than its limit; a line each."""
        before, after = asdict(early), asdict(self)
        return [
            f"{name}: {before[name]:.6g} to {after[name]:.6g}"
            for name, limit in limits.items()
            if after[name] - before[name] > limit
        ]


def print_row(values: Mapping[str, Any], *, head: bool) -> None:
    """A line of a Markdown table, below its head where that is asked for."""
    if head:
        print(f"| {' | '.join(name.replace('_', ' ') for name in values)} |")
        print("|---" * len(values) + "|")
    cells = (f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in values.values())
    print(f"| {' | '.join(cells)} |", flush=True)


def arrived(node: Wrenches, name: str) -> tuple[NDArray[np.float64], int]:
    """Latency ms of a sensor's wrenches since the last call, and frames lost; both forgotten."""
    seen, lost = node.seen[name], node.lost(name)
    stamps, arrivals = np.array(seen, dtype=np.int64).T
    # The last one stays: the gap after it belongs to the next part.
    del seen[:-1]
    frames = node.frames[name]
    frames[:] = [frame for frame in frames if frame >= seen[0][0]]
    return 1e-6 * (arrivals - stamps), lost


def main() -> int:
    """Run, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--input", default="grasp", help="recording, or packaged scene")
    options = parser.parse_args()
    rclpy.init()
    node, executor = Wrenches(["sensor"]), SingleThreadedExecutor()
    executor.add_node(node)
    parts: list[dict[str, float]] = []
    footprints: list[Footprint] = []
    with container(options.input, ["sensor"], options.rate, "every") as process:
        spin_until(executor, node, 1, process)
        for _ in range(PARTS):
            begin, busy = time.monotonic(), busy_s(process.pid)
            spin_until(executor, node, 1 + options.frames // PARTS, process)
            latency, lost = arrived(node, "sensor")
            footprints.append(Footprint.from_process(process.pid))
            cores = (busy_s(process.pid) - busy) / (time.monotonic() - begin)
            median, p99 = np.percentile(latency, (50, 99)).tolist()
            part = {"frames": len(latency) - 1, "lost": lost, "median_ms": median, "p99_ms": p99}
            print_row({**part, **asdict(footprints[-1]), "cores": cores}, head=not parts)
            parts.append(part)
    node.destroy_node()
    rclpy.try_shutdown()
    found = footprints[-1].grown(footprints[1], MAX_GROWTH)
    early, late = parts[1]["median_ms"], parts[-1]["median_ms"]
    if late > MAX_LATENCY_FACTOR * early:
        found.append(f"median latency: {early:.1f} to {late:.1f} ms")
    lost, frames = (sum(part[name] for part in parts) for name in ("lost", "frames"))
    print(f"{frames} frames, {lost} lost; {'; '.join(found) or 'nothing grew'}")
    return 1 if found or lost else 0


if __name__ == "__main__":
    sys.exit(main())
