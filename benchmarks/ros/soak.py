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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from real_time import Wrenches, busy_s, container, spin_until

PARTS = 20
# Between the second part and the last.  Memory: what the allocator and DDS's histories settle by.
MAX_GROWTH_MB = 20.0
MAX_GROWTH_HANDLES = 4
MAX_LATENCY_FACTOR = 1.25


@dataclass(frozen=True)
class Part:
    """One part of the run.  latency_ms: median and 99 %; cores: processors kept busy."""

    frames: int
    lost: int
    latency_ms: tuple[float, float]
    memory_mb: float
    handles: int
    threads: int
    cores: float

    def row(self) -> str:
        """As a line of a Markdown table."""
        median, p99 = self.latency_ms
        return (
            f"| {self.frames} | {self.lost} | {median:.1f} | {p99:.1f} | {self.memory_mb:.1f} | "
            f"{self.handles} | {self.threads} | {self.cores:.2f} |"
        )


def growth(parts: list[Part]) -> list[str]:
    """What grew by more than allowed; a line each."""
    early, late = parts[1], parts[-1]
    found = []
    if late.memory_mb - early.memory_mb > MAX_GROWTH_MB:
        found.append(f"memory: {early.memory_mb:.1f} to {late.memory_mb:.1f} MB")
    for name in ("handles", "threads"):
        before, after = getattr(early, name), getattr(late, name)
        if after - before > MAX_GROWTH_HANDLES:
            found.append(f"{name}: {before} to {after}")
    if late.latency_ms[0] > MAX_LATENCY_FACTOR * early.latency_ms[0]:
        found.append(f"median latency: {early.latency_ms[0]:.1f} to {late.latency_ms[0]:.1f} ms")
    return found


def _part(node: Wrenches, pid: int, since: tuple[float, float]) -> Part:
    """What came since the last part, which is forgotten here; since: clock and processor time."""
    ((name, seen),) = node.seen.items()
    lost = node.lost(name)
    stamps, arrivals = np.array(seen, dtype=np.int64).T
    latency = 1e-6 * (arrivals - stamps)
    # The last one stays: the gap after it belongs to the next part.
    del seen[:-1]
    frames = node.frames[name]
    frames[:] = [frame for frame in frames if frame >= seen[0][0]]
    status = dict(
        line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines()
    )
    begin, busy = since
    return Part(
        frames=len(stamps) - 1,
        lost=lost,
        latency_ms=(float(np.median(latency)), float(np.percentile(latency, 99))),
        memory_mb=int(status["VmRSS"].split()[0]) / 1024,
        handles=len(list(Path(f"/proc/{pid}/fd").iterdir())),
        threads=int(status["Threads"]),
        cores=(busy_s(pid) - busy) / (time.monotonic() - begin),
    )


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
    parts: list[Part] = []
    print("| frames | lost | median ms | p99 ms | memory MB | handles | threads | cores |")
    print("|---|---|---|---|---|---|---|---|")
    with container(options.input, ["sensor"], options.rate, "every") as process:
        spin_until(executor, node, 1, process)
        for _ in range(PARTS):
            since = (time.monotonic(), busy_s(process.pid))
            spin_until(executor, node, 1 + options.frames // PARTS, process)
            parts.append(_part(node, process.pid, since))
            print(parts[-1].row(), flush=True)
    node.destroy_node()
    rclpy.try_shutdown()
    found = growth(parts)
    lost, frames = sum(part.lost for part in parts), sum(part.frames for part in parts)
    print(f"{frames} frames, {lost} lost; {'; '.join(found) or 'nothing grew'}")
    return 1 if found or lost else 0


if __name__ == "__main__":
    sys.exit(main())
