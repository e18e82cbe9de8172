#!/usr/bin/env python3
"""Processor time of a frame from the image to force and slip, compared with OpenCV's detector.

Each frame goes in turn through OpenCV's classic detector with cornerSubPix, through `Pipeline`, and
through its stages one by one, so a slow machine slows all of them alike. Ratios are to OpenCV in
the same run: on both views, or on one view for the times of a single view. All times are processor
times, except the row `the same by the clock`. --peers adds OpenCV's sector based detector (SB),
mrgingham if it is installed, and the paper's contour stitching. --compile adds the time to compile
all kernels on one core.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from inputs import Input, add_options, chosen
from numpy.typing import NDArray
from tables import CommandLine, head, keep, line
from tracking.detectors import Ours, Peer, children_time, peers

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Surface
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.processes import python_command
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker

Image = NDArray[np.uint8]
BOTH, ONE = ", both views", ", one view"
PEER = "OpenCV classic + cornerSubPix"
FRAME, CLOCK = "processor time of a frame to force and slip", "the same by the clock"
FOLLOWED, SCRATCH = f"tracked, followed{ONE}", f"tracked, from scratch{ONE}"
TRIANGULATION, FORCE = "triangulation with covariance", "force and slip"
IN_CONTACT, WITHOUT = ", in contact", ", without contact"
HELD, CHANGING = " of a held contact", " of a changing contact"
# Frames after which the caches of processor and stages are warm.
WARM_UP = 3
# A contact is held where markers move less than this from frame to frame, RMS, m: noise is below.
STILL_M = 5e-6
# Of the frames that all peers see, one in so many; of those for OpenCV where it takes long, s.
SOME, SELDOM, SLOW_S = 4, 10, 0.2


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
        self.add(name, clock() - began)
        return result

    def add(self, name: str, seconds: float) -> None:
        """Keep a duration."""
        self.found.setdefault(name, []).append(seconds)

    def table(self) -> dict[str, dict[str, float]]:
        """Median and 99 % of every name in ms, and both over the median of OpenCV's."""
        peer = {view: float(np.median(self.found[PEER + view])) for view in (BOTH, ONE)}
        rows = {}
        for name, seconds in self.found.items():
            median, most = (float(value) for value in np.percentile(seconds, [50, 99]))
            base = peer[ONE if name.endswith(ONE) else BOTH]
            rows[name] = {
                "median_ms": round(1e3 * median, 3),
                "p99_ms": round(1e3 * most, 3),
                "ratio": round(median / base, 3),
                "p99_ratio": round(most / base, 3),
                "frames": len(seconds),
            }
        return rows


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """OpenCV with one thread, as its processor time is that of this thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


class Chain:
    """`Pipeline` of a sensor, its stages one by one, and a peer on the same frames."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.sensor = sensor
        self.pipeline, self.stereo = Pipeline(sensor), StereoRig(sensor)
        self.trackers = {name: GridTracker(sensor, name) for name in self.stereo.views}
        self.cold = {name: GridTracker(sensor, name) for name in self.stereo.views}
        self.reference, self.stage = Reference.nominal(sensor), ForceStage(sensor)
        self._before: Surface | None = None

    def reset(self) -> None:
        """Forget earlier frames."""
        for each in (self.pipeline, self.stage, *self.trackers.values()):
            each.reset()
        self._before = None

    def views(self, image: Image) -> dict[str, Image]:
        """Both views, cut out."""
        views = self.stereo.views.items()
        return {name: split_frame(image, view.placement) for name, view in views}

    def measure(self, image: Image, stamp: int, times: Times, peer: Peer | None = None) -> None:
        """Add the times of the next frame."""
        views = self.views(image)
        grids = self._track(views, times)
        if peer is not None:
            take_peer(peer, self.sensor, views, grids, times)
        force = self._stages(grids, stamp, times)
        state = IN_CONTACT if force.contact.any() else WITHOUT
        used, began = time.process_time(), time.perf_counter()
        self.pipeline.process(image, stamp)
        times.add(FRAME + state, time.process_time() - used)
        times.add(CLOCK + state, time.perf_counter() - began)

    def _track(self, views: Mapping[str, Image], times: Times) -> dict[str, Grid]:
        grids = {}
        for name, cut in views.items():
            self.cold[name].reset()
            times.take(SCRATCH, self.cold[name].track, cut, clock=time.thread_time)
            track = self.trackers[name].track
            grids[name] = times.take(FOLLOWED, track, cut, clock=time.thread_time)
        return grids

    def _stages(self, grids: Mapping[str, Grid], stamp: int, times: Times) -> Any:
        both = grids.get("left"), grids.get("right")
        triangulate = self.stereo.triangulate
        markers = times.take(TRIANGULATION, triangulate, *both, clock=time.thread_time)
        surface = self.reference.surface(markers)
        began = time.thread_time()
        force = self.stage.process(surface, stamp)
        used = time.thread_time() - began
        held = HELD if self._is_still(surface) else CHANGING
        times.add(FORCE + (held if force.contact.any() else WITHOUT), used)
        return force

    def _is_still(self, surface: Surface) -> bool:
        before, self._before = self._before, surface
        if before is None:
            return False
        moved = np.linalg.norm(surface.position - before.position, axis=-1)
        return bool(np.sqrt(np.nanmean(moved**2)) < STILL_M)


def take_peer(
    peer: Peer | Ours,
    sensor: SensorDescription,
    views: Mapping[str, Image],
    grids: Mapping[str, Grid],
    times: Times,
) -> None:
    """Add a peer's times on each view and on both."""
    with one_opencv_thread():
        seconds = [
            peer.detect(sensor, name, cut, grids[name]).seconds for name, cut in views.items()
        ]
    for each in seconds:
        times.add(peer.name + ONE, each)
    times.add(peer.name + BOTH, sum(seconds))


def measure(given: Input, rounds: int, *, with_peers: bool = False) -> dict[str, dict[str, float]]:
    """The table of an input: rounds over all of its frames, after one that is not counted."""
    chain, times, classic = Chain(given.sensor), Times(), peers()[0]
    frames = list(given.frames())
    for round_number in range(rounds + 1):
        chain.reset()
        for number, (image, stamp) in enumerate(frames):
            keep = times if round_number and number >= WARM_UP else Times()
            slow = max(times.found.get(PEER + BOTH, [0.0])) > SLOW_S
            peer = None if slow and number % SELDOM else classic
            chain.measure(image, stamp, keep, peer)
    if with_peers:
        _all_peers(chain, [image for image, _ in frames], times)
    return times.table()


def _all_peers(chain: Chain, images: list[Image], times: Times) -> None:
    """The other peers on some of the frames: they are slow."""
    stitching = Ours("contour stitching", follow=False, detector="contour_stitching")
    for rival in (*peers()[1:], stitching):
        for image in images[::SOME]:
            views = chain.views(image)
            grids = {name: chain.trackers[name].track(cut) for name, cut in views.items()}
            take_peer(rival, chain.sensor, views, grids, times)


def compiling(sensor: str) -> dict[str, float]:
    """Processor time, s, of preparing a sensor with an empty cache of compiled code on one core.

    Without what the same takes with a full one; functions: how many are then in the cache.
    """
    with tempfile.TemporaryDirectory(prefix="compiled_") as folder:
        cold, warm = (_prepared(sensor, folder) for _ in range(2))
        functions = sum(1 for _ in Path(folder).rglob("*.nbi"))
    return {"compiling_s": round(cold - warm, 1), "functions": functions}


def _prepared(sensor: str, folder: str) -> float:
    command = python_command("cmp_tactile_processing.prepare", sensor)
    core = min(os.sched_getaffinity(0))
    before = children_time()
    subprocess.run(
        ["taskset", "-c", str(core), *command],  # noqa: S607
        env={**os.environ, "NUMBA_CACHE_DIR": folder},
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return children_time() - before


def main() -> None:
    """Measure, print, and keep."""
    parser = CommandLine(__doc__.partition("\n\n")[0])
    add_options(parser)
    parser.option("--rounds", "repetitions", 3)
    parser.option("--peers", "measure all detectors, not only OpenCV's classic one", False)
    parser.option("--compile", "also measure the time to compile all kernels", False)
    parser.add_json()
    arguments, columns = parser.parse_args(), ("median_ms", "p99_ms", "ratio", "frames")
    inputs = chosen(arguments)
    for given in inputs:
        rows = measure(given, arguments.rounds, with_peers=arguments.peers)
        print(head(given.name, "median ms", "99 % ms", "ratio to OpenCV", "frames"))
        for row, values in rows.items():
            print(line(row, *(values[column] for column in columns)))
        if arguments.json:
            keep(arguments.json, {given.name: rows})
    if arguments.compile:
        found = compiling(inputs[0].sensor_file)
        print(found)
        if arguments.json:
            keep(arguments.json, {"compiling": found})


if __name__ == "__main__":
    main()
