#!/usr/bin/env python3
"""Time of a frame from the image to force and slip, offline, beside peers on the same frames.

Peers see both views of every frame that is timed: OpenCV's classic detector with cornerSubPix, its
sector based one (SB), mrgingham where it is installed, and the paper's contour stitching.  Ratios
are against the first; milliseconds are those of this machine.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from tracking.detectors import Ours, Peer, peers

from cmp_tactile_bringup.recordings.simulated import Recording, find_recording
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Surface
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker

Image = NDArray[np.uint8]
PEER = "OpenCV classic + cornerSubPix, both views"
# Frames after which the caches of processor and stages are warm.
WARM_UP = 3


class Times:
    """Durations by name, s."""

    def __init__(self) -> None:
        self.found: dict[str, list[float]] = {}

    def take(
        self, name: str, work: Callable[..., Any], *given: Any, clock: Callable[[], float]
    ) -> Any:
        """What the work returns; its time is kept."""
        began = clock()
        result = work(*given)
        self.found.setdefault(name, []).append(clock() - began)
        return result

    def table(self) -> dict[str, dict[str, float]]:
        """Median and 99 % of every name in ms, and the median over that of the peer."""
        peer = float(np.median(self.found[PEER]))
        rows = {}
        for name, seconds in self.found.items():
            median, most = np.percentile(seconds, [50, 99])
            rows[name] = {
                "median_ms": 1e3 * float(median),
                "p99_ms": 1e3 * float(most),
                "ratio": float(median) / peer,
                "frames": len(seconds),
            }
        return rows


class Scene:
    """A simulated recording: frames, stamps, and which of them are in contact."""

    def __init__(self, name: str) -> None:
        self.recording: Recording = find_recording(name)
        self.sensor = SensorDescription.load(self.recording.sensor)
        bag = self.recording.bag
        played = open_recording(bag, topic="", frame_rate=30, frame_id="", expected_size=None)
        frames = [item for item in played.messages() if isinstance(item, RecordedFrame)]
        self.frames = [(item.image, item.stamp_ns) for item in frames]
        self.touches = [
            bool(np.any(self.recording.true_force(number).force)) for number in range(len(frames))
        ]


def whole_pipeline(scene: Scene, times: Times, rounds: int) -> None:
    """`Pipeline.process`: by the clock on the wall, and in processor time of all its threads."""
    pipeline = Pipeline(scene.sensor)
    for round_number in range(rounds + 1):
        pipeline.reset()
        for number, ((image, stamp), touches) in enumerate(
            zip(scene.frames, scene.touches, strict=True)
        ):
            keep = times if round_number and number >= WARM_UP else Times()
            state = "in contact" if touches else "without contact"
            used = time.process_time()
            keep.take(
                f"Pipeline.process, {state}", pipeline.process, image, stamp,
                clock=time.perf_counter,
            )  # fmt: skip
            keep.found.setdefault(f"processor time of a frame, {state}", []).append(
                time.process_time() - used
            )


def tracked(scene: Scene, times: Times, rounds: int) -> Iterator[tuple[dict[str, Grid], int, bool]]:
    """Time both views, followed and from scratch; the grids of the last round are yielded."""
    views = StereoRig(scene.sensor).views
    trackers = {name: GridTracker(scene.sensor, name) for name in views}

    def both(cuts: dict[str, Image]) -> dict[str, Grid]:
        return {name: trackers[name].track(cut) for name, cut in cuts.items()}

    for round_number in range(rounds + 1):
        for number, (image, stamp) in enumerate(scene.frames):
            cuts = {name: split_frame(image, view.placement) for name, view in views.items()}
            keep = times if round_number and number >= WARM_UP else Times()
            grids = keep.take("both views, followed", both, cuts, clock=time.thread_time)
            if round_number == rounds:
                yield grids, stamp, scene.touches[number]
    for image, _ in scene.frames:
        cuts = {name: split_frame(image, view.placement) for name, view in views.items()}
        for tracker in trackers.values():
            tracker.reset()
        times.take("both views, from scratch", both, cuts, clock=time.thread_time)


def stereo_and_force(scene: Scene, times: Times, rounds: int) -> None:
    """Tracking, and with its grids triangulation and force."""
    rig, reference = StereoRig(scene.sensor), Reference.nominal(scene.sensor)
    surfaces: list[tuple[Surface, int, bool]] = []
    for grids, stamp, touches in tracked(scene, times, rounds):
        for _ in range(rounds):
            markers = times.take(
                "triangulation with covariance", rig.triangulate, grids.get("left"),
                grids.get("right"), clock=time.thread_time,
            )  # fmt: skip
        surfaces.append((reference.surface(markers), stamp, touches))
    stage = ForceStage(scene.sensor)
    for round_number in range(rounds + 1):
        stage.reset()
        before = False
        for number, (surface, stamp, touches) in enumerate(surfaces):
            keep = times if round_number and number >= WARM_UP else Times()
            state = "a held contact" if before else "the first frame of a contact"
            name = f"force and slip, {state if touches else 'no contact'}"
            keep.take(name, stage.process, surface, stamp, clock=time.thread_time)
            before = touches


def detectors(scene: Scene, times: Times) -> None:
    """Peers and contour stitching on both views of the frames in contact."""
    views = StereoRig(scene.sensor).views
    rivals: Sequence[Peer | Ours] = [
        *peers(),
        Ours("contour stitching", follow=False, detector="contour_stitching"),
    ]
    tracker = {name: GridTracker(scene.sensor, name) for name in views}
    for (image, _), touches in zip(scene.frames, scene.touches, strict=True):
        if not touches:
            continue
        cuts = {name: split_frame(image, view.placement) for name, view in views.items()}
        truth = {name: tracker[name].track(cut) for name, cut in cuts.items()}
        for rival in rivals:
            seconds = sum(
                rival.detect(scene.sensor, name, cut, truth[name]).seconds
                for name, cut in cuts.items()
            )
            times.found.setdefault(f"{rival.name}, both views", []).append(seconds)


def main() -> None:
    """Measure, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", nargs="+", default=["grasp", "slip"], help="(%(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="(%(default)d)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="file to write the figures into")
    arguments = parser.parse_args()
    figures, console = {}, Console()
    for name in arguments.scene:
        scene, times = Scene(name), Times()
        detectors(scene, times)
        whole_pipeline(scene, times, arguments.rounds)
        stereo_and_force(scene, times, arguments.rounds)
        figures[name] = times.table()
        table = Table("", "median ms", "99 % ms", "over OpenCV classic", "frames", title=name)
        for row, values in figures[name].items():
            table.add_row(
                row, f"{values['median_ms']:.2f}", f"{values['p99_ms']:.2f}",
                f"{values['ratio']:.2f}", str(values["frames"]),
            )  # fmt: skip
        console.print(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
