"""A sensor comes and goes in a container, again and again, while another runs there.

setup/run python3 benchmarks/ros/container_cycles.py [--cycles 100] [--rate 30]

In each cycle all components of a sensor are loaded through the container's services, run until
some wrenches came, and are unloaded.  Prints a row for each tenth of the cycles, then what grew
from the second row to the last.  Exits with 1 where that is more than allowed, a frame of the
sensor that stays was lost, or the container does not end with 0.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cameras import cameras
from rclpy.executors import SingleThreadedExecutor
from real_time import Wrenches, container, spin_until

from cmp_tactile_bringup.container.graph_runner import ContainerClient, container_client
from cmp_tactile_bringup.container.services import REQUEST_THREADS
from cmp_tactile_bringup.graphs.description import Graph
from cmp_tactile_bringup.recordings.simulated import find_recording

STAYS, GUEST = "stays", "guest"
CONTAINER = f"/{STAYS}/tactile_container"
PARTS = 10
WRENCHES = 5
# A node of rclpy leaves 0.1 MB behind in ROS and DDS when it is destroyed, a sensor has seven.
MAX_GROWTH_MB_PER_CYCLE = 1.5
MAX_GROWTH_HANDLES = 4
# Those that serve requests come one by one when they are needed first.
MAX_GROWTH_THREADS = REQUEST_THREADS
SILENCE_S = 120.0


@dataclass(frozen=True)
class State:
    """Of the container after some cycles.  lost: frames of the sensor that stays, in this part."""

    cycles: int
    load_s: float
    unload_s: float
    lost: int
    latency_ms: float
    memory_mb: float
    handles: int
    threads: int

    def row(self) -> str:
        """As a line of a Markdown table."""
        return (
            f"| {self.cycles} | {self.load_s:.2f} | {self.unload_s:.2f} | {self.lost} | "
            f"{self.latency_ms:.1f} | {self.memory_mb:.1f} | {self.handles} | {self.threads} |"
        )


class Cycles:
    """Loads and unloads the guest on a thread of its own, one cycle at a time."""

    def __init__(self, client: ContainerClient, graph: Graph, node: Wrenches) -> None:
        self._client, self._graph, self._node = client, graph, node
        self.load_s: list[float] = []
        self.unload_s: list[float] = []
        self.failure = ""

    def run(self, count: int) -> threading.Thread:
        """Begin so many cycles; join the thread that is returned."""
        thread = threading.Thread(target=self._run, args=(count,), daemon=True)
        thread.start()
        return thread

    def _run(self, count: int) -> None:
        try:
            for _ in range(count):
                self._cycle()
        except Exception as error:  # noqa: BLE001  reported by the main thread
            self.failure = f"{type(error).__name__}: {error}"

    def _cycle(self) -> None:
        seen = self._node.seen[GUEST]
        began = time.monotonic()
        for component in self._graph.components:
            self._client.load(component)
        self.load_s.append(time.monotonic() - began)
        wanted = len(seen) + WRENCHES
        while len(seen) < wanted:
            if time.monotonic() - began > SILENCE_S:
                msg = f"{len(seen)} wrenches of the guest, expected {wanted}"
                raise TimeoutError(msg)
            time.sleep(0.02)
        began = time.monotonic()
        self._client.unload_all(timeout_s=30.0)
        self.unload_s.append(time.monotonic() - began)


def _state(cycles: Cycles, node: Wrenches, pid: int) -> State:
    """Since the last call, whose wrenches are forgotten here."""
    stamps, arrivals = np.array(node.seen[STAYS], dtype=np.int64).T
    lost = node.lost(STAYS)
    # The last one stays: the gap after it belongs to the next part.
    del node.seen[STAYS][:-1]
    frames = node.frames[STAYS]
    frames[:] = [frame for frame in frames if frame >= node.seen[STAYS][0][0]]
    process = Path(f"/proc/{pid}")
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    part = slice(-max(1, len(cycles.load_s) // PARTS), None)
    return State(
        cycles=len(cycles.unload_s),
        load_s=float(np.median(cycles.load_s[part])),
        unload_s=float(np.median(cycles.unload_s[part])),
        lost=lost,
        latency_ms=float(1e-6 * np.median(arrivals - stamps)),
        memory_mb=int(status["VmRSS"].split()[0]) / 1024,
        handles=len(list((process / "fd").iterdir())),
        threads=int(status["Threads"]),
    )


def _growth(states: list[State]) -> list[str]:
    early, late = states[1], states[-1]
    found = []
    per_cycle = (late.memory_mb - early.memory_mb) / max(1, late.cycles - early.cycles)
    print(f"memory: {per_cycle:.2f} MB per cycle")
    if per_cycle > MAX_GROWTH_MB_PER_CYCLE:
        found.append(f"memory by {per_cycle:.2f} MB per cycle")
    for name, limit in (("handles", MAX_GROWTH_HANDLES), ("threads", MAX_GROWTH_THREADS)):
        before, after = getattr(early, name), getattr(late, name)
        if after - before > limit:
            found.append(f"{name}: {before} to {after}")
    return found


def _measure(options: argparse.Namespace, client: ContainerClient, node: Wrenches) -> list[State]:
    recording = find_recording(options.input)
    arguments = {"input": str(recording.bag), "sensor": str(recording.sensor), "names": GUEST}
    graph = cameras.load({**arguments, "frame_rate": str(options.guest_rate)})
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    states: list[State] = []
    with container(options.input, [STAYS], options.rate, "every") as process:
        node.seen[GUEST].extend([(0, 0)] * 10_000)  # only the other one is waited for
        spin_until(executor, node, 30, process)
        client.find(60.0)
        cycles = Cycles(client, graph, node)
        node.seen[STAYS].clear()
        for _ in range(PARTS):
            thread = cycles.run(max(1, options.cycles // PARTS))
            while thread.is_alive():
                executor.spin_once(timeout_sec=0.1)
            if cycles.failure or process.poll() is not None:
                sys.exit(f"{cycles.failure}; container: {process.poll()}")
            states.append(_state(cycles, node, process.pid))
            print(states[-1].row(), flush=True)
    executor.shutdown()
    return states


def main() -> int:
    """Run, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--rate", type=float, default=30.0, help="of the sensor that stays, Hz")
    parser.add_argument("--guest-rate", type=float, default=10.0, help="of the other, Hz")
    parser.add_argument("--input", default="grasp", help="recording, or packaged scene")
    options = parser.parse_args()
    print("| cycles | load s | unload s | lost | median ms | memory MB | handles | threads |")
    print("|---|---|---|---|---|---|---|---|")
    with container_client([sys.argv[0]], CONTAINER, lambda: False) as client:
        node = Wrenches([STAYS, GUEST])
        states = _measure(options, client, node)
        node.destroy_node()
    found = _growth(states)
    lost = sum(state.lost for state in states)
    print(f"{states[-1].cycles} cycles, {lost} frames lost; {'; '.join(found) or 'nothing grew'}")
    return 1 if found or lost else 0


if __name__ == "__main__":
    sys.exit(main())
