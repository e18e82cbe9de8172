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
from dataclasses import asdict

import numpy as np
from cameras import cameras
from rclpy.executors import SingleThreadedExecutor
from real_time import Wrenches, container, spin_until
from soak import Footprint, arrived, print_row

from cmp_tactile_bringup.container.graph_runner import ContainerClient, container_client
from cmp_tactile_bringup.graphs.description import Graph
from cmp_tactile_bringup.recordings.simulated import find_recording

STAYS, GUEST = "stays", "guest"
CONTAINER = f"/{STAYS}/tactile_container"
PARTS = 10
WRENCHES = 5
# A node of rclpy leaves 0.1 MB behind in ROS and DDS when it is destroyed, a sensor has seven.
MAX_GROWTH_MB_PER_CYCLE = 1.5
MAX_GROWTH = {"handles": 4, "threads": 2}
SILENCE_S = 120.0

Part = tuple[dict[str, float], Footprint]


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


def _figures(cycles: Cycles, node: Wrenches) -> dict[str, float]:
    """Since the last call, whose wrenches are forgotten here; lost: of the sensor that stays."""
    latency, lost = arrived(node, STAYS)
    part = slice(-max(1, len(cycles.load_s) // PARTS), None)
    return {
        "cycles": len(cycles.unload_s),
        "load_s": float(np.median(cycles.load_s[part])),
        "unload_s": float(np.median(cycles.unload_s[part])),
        "lost": lost,
        "median_ms": float(np.median(latency)),
    }


def _measure(options: argparse.Namespace, client: ContainerClient, node: Wrenches) -> list[Part]:
    recording = find_recording(options.input)
    arguments = {"input": str(recording.bag), "sensor": str(recording.sensor), "names": GUEST}
    graph = cameras.load({**arguments, "frame_rate": str(options.guest_rate)})
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    parts: list[Part] = []
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
            figures, footprint = _figures(cycles, node), Footprint.from_process(process.pid)
            print_row({**figures, **asdict(footprint)}, head=not parts)
            parts.append((figures, footprint))
    executor.shutdown()
    return parts


def main() -> int:
    """Run, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--rate", type=float, default=30.0, help="of the sensor that stays, Hz")
    parser.add_argument("--guest-rate", type=float, default=10.0, help="of the other, Hz")
    parser.add_argument("--input", default="grasp", help="recording, or packaged scene")
    options = parser.parse_args()
    with container_client([sys.argv[0]], CONTAINER, lambda: False) as client:
        node = Wrenches([STAYS, GUEST])
        parts = _measure(options, client, node)
        node.destroy_node()
    (first, early), (last, late) = parts[1], parts[-1]
    found = late.grown(early, MAX_GROWTH)
    cycles = last["cycles"] - first["cycles"]
    per_cycle = (late.memory_mb - early.memory_mb) / max(1, cycles)
    print(f"memory: {per_cycle:.2f} MB per cycle")
    if per_cycle > MAX_GROWTH_MB_PER_CYCLE:
        found.append(f"memory by {per_cycle:.2f} MB per cycle")
    lost = sum(figures["lost"] for figures, _ in parts)
    print(f"{last['cycles']} cycles, {lost} frames lost; {'; '.join(found) or 'nothing grew'}")
    return 1 if found or lost else 0


if __name__ == "__main__":
    sys.exit(main())
