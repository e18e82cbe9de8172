#!/usr/bin/env python3
"""What a live grasp costs, and how much of real time it reaches beside the nodes of both sensors.

    setup/run python3 benchmarks/ros/grasp_rate.py box flask egg

Processor times are also given as ratios to OpenCV's classic detector with cornerSubPix on both
views of the same frames.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from pipeline_speed import one_opencv_thread
from tables import CommandLine, head, line
from tracking.detectors import peers

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.processes import python_command
from cmp_tactile_processing.ros.process import Listener
from cmp_tactile_simulation.grasp.live import LiveGrasp, LiveGraspSettings
from cmp_tactile_simulation.grasp.scene import load_grasp
from cmp_tactile_simulation.rendering.renderer import OpticalTruth

CHUNK_S, WARM_UP_S = 0.01, 1.0
SHARE, PHASE = "share of real time", "phase"


def cost(name: str) -> tuple[float, float, float]:
    """Processor time of mechanics a second, of a pair of frames, and of OpenCV on these, s."""
    scene, opencv = load_grasp(name), peers()[0]
    truths = {side: OpticalTruth(sensor) for side, sensor in scene.described.items()}
    grasp = LiveGrasp(scene, LiveGraspSettings(loop=False))
    grasp.taken = sys.maxsize
    mechanics = pictures = found = 0.0
    chunks, frames = round(1 / scene.rate / CHUNK_S), 0
    for number in range(round(scene.duration / CHUNK_S)):
        begin = time.process_time()
        grasp.advance(CHUNK_S)
        mechanics += time.process_time() - begin
        if number % chunks:
            continue
        begin = time.process_time()
        moment = grasp.moment()
        drawn = grasp.pictures(moment)
        pictures += time.process_time() - begin
        for side, image in drawn.items():
            for view, grid in truths[side].grids(moment.surfaces[side]).items():
                cut = split_frame(image, grid.placement)
                with one_opencv_thread():
                    found += opencv.detect(scene.described[side], view, cut, grid).seconds
        frames += 1
    return mechanics / scene.duration, pictures / frames, found / frames


class Shares(Listener):
    """Shares of real time that a running grasp reports while its motion plays."""

    def __init__(self) -> None:
        super().__init__("grasp_rate")
        self.found: list[float] = []

    def _subscribe(self) -> None:
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, 100)

    def _on_report(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            if SHARE in values and values[PHASE] not in ("", "taking references"):
                self.found.append(float(values[SHARE]))


def live(name: str, seconds: float) -> float:
    """Mean share of real time with the nodes of both sensors, in processes of their own."""
    command = python_command("cmp_tactile_bringup.command", "grasp", name, "--live")
    with Shares() as shares, subprocess.Popen(command, stdout=subprocess.DEVNULL) as running:
        end = time.monotonic() + 5 * seconds
        while len(shares.found) < seconds and time.monotonic() < end:
            time.sleep(0.5)
        running.terminate()
    return statistics.mean(shares.found) if shares.found else float("nan")


def main() -> None:
    """Print a table of the scenes."""
    command = CommandLine(__doc__)
    command.add_argument("scenes", nargs="*", default=["box", "flask", "egg"])
    command.add_argument("--seconds", type=float, default=30.0, help="of each live grasp")
    given = command.parse_args()
    print(head("grasp", "mechanics, ms a second", "pair of frames, ms", "OpenCV", "real time"))
    for name in given.scenes:
        mechanics, pictures, opencv = cost(name)
        cells = [f"{1e3 * mechanics:.0f} ({mechanics / opencv:.0f})"]
        cells += [f"{1e3 * pictures:.1f} ({pictures / opencv:.1f})", f"{1e3 * opencv:.1f} (1)"]
        print(line(name, *cells, f"{live(name, given.seconds):.2f}"), flush=True)


if __name__ == "__main__":
    main()
