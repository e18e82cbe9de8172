"""How fast the live simulated source is, by itself and with the whole graph beside it.

Peer: the offline path of the same scene, 4 x 4 samples a pixel and 40 x 40 contact nodes, which
takes every frame of the motion in turn.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from cmp_tactile_bringup.demo import Collector, ContainerProcess
from cmp_tactile_processing.ros.messages.reading import stamp_ns
from cmp_tactile_simulation.live.motion import LiveMode
from cmp_tactile_simulation.live.source import SimulatedSource
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation

SETTLE_S = 5.0
START_TIMEOUT_S = 600.0


def offline_rate(scene_name: str, frames: int) -> float:
    """Frames per second of the offline path, once all is compiled and built."""
    scene = replace(load_scene(scene_name), contact_nodes=40, samples=4)
    made = Simulation(scene).frames()
    next(made)
    # Frames are made ahead: from the middle of the motion on, in the pace of all that is done.
    began = time.monotonic()
    count = sum(1 for _ in islice(made, frames))
    return count / (time.monotonic() - began)


def standalone(scene_name: str, seconds: float) -> dict[str, float]:
    """Frames per second of the live source read as fast as it goes, and the time of its steps."""
    source = SimulatedSource(load_scene(scene_name))
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while (frame := source.read()).status.mode is LiveMode.BUILDING:
            if time.monotonic() > deadline:
                raise TimeoutError(frame.status.note)
        end = time.monotonic() + SETTLE_S
        while time.monotonic() < end:
            source.read()
        began, frames = time.monotonic(), 0
        while time.monotonic() < began + seconds:
            frame = source.read()
            frames += 1
        took = time.monotonic() - began
        if frame.status.mode is not LiveMode.PLAYING:
            msg = f"found the indenter {frame.status}, expected {LiveMode.PLAYING}"
            raise RuntimeError(msg)
        return {"rate": frames / took, "step_ms": frame.status.step_s * 1e3}
    finally:
        source.close()


def with_graph(scene_name: str, seconds: float) -> dict[str, float]:
    """Wrenches per second with all nodes of the graph in one container, and their age."""
    sensor = load_scene(scene_name).sensor
    arguments = {"scene": scene_name}
    with (
        tempfile.TemporaryDirectory() as folder,
        Collector(f"/{sensor.ros_name}") as collector,
        ContainerProcess("simulate", arguments, Path(folder) / "log") as container,
    ):
        container.wait_for(lambda: collector.count("wrench") > 0, START_TIMEOUT_S, "frames")
        time.sleep(SETTLE_S)
        before = collector.count("wrench")
        time.sleep(seconds)
        arrivals = collector.arrivals("wrench")[before:]
    ages = [item.arrived_ns - stamp_ns(item.message.header.stamp) for item in arrivals]
    return {"rate": len(arrivals) / seconds, "age_ms": float(np.median(ages)) * 1e-6}


def main() -> None:
    """Measure and print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="grasp", help="scene to play (%(default)s)")
    parser.add_argument("--seconds", type=float, default=15.0, help="of each part (%(default)g)")
    parser.add_argument("--frames", type=int, default=20, help="of the peer (%(default)s)")
    arguments = parser.parse_args()
    peer = offline_rate(arguments.scene, arguments.frames)
    alone = standalone(arguments.scene, arguments.seconds)
    graph = with_graph(arguments.scene, arguments.seconds)
    table = Table("", "Hz", "times the peer", "", title=f"Live source, scene {arguments.scene}")
    for name, rate, remark in (
        ("offline, 4 x 4 samples, 40 x 40 nodes (peer)", peer, ""),
        ("live, as fast as it goes", alone["rate"], f"contact step {alone['step_ms']:.0f} ms"),
        (
            "live at 20 Hz, the whole graph beside it",
            graph["rate"],
            f"wrench {graph['age_ms']:.0f} ms old",
        ),
    ):
        table.add_row(name, f"{rate:.1f}", f"{rate / peer:.1f}", remark)
    Console().print(table)


if __name__ == "__main__":
    main()
