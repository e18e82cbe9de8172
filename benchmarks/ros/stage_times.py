#!/usr/bin/env python3
"""Time of every stage over a recording, as a ratio to tracking in the same run, and who waits.

Peer: tracking one view of the same frames. `held` is the share of a stage's time in which no other
Python thread can run (what compiled code does without Python's lock is not counted), the least of
all rounds; "-" where no round found a second core with nothing else to do.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from std_msgs.msg import Header

from cmp_tactile_bringup.recordings.simulated import find_recording
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.ros.messages import conversions, reading
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker

PEER = "tracking"
# Frames after which caches of the processor and of the stages are warm.
WARM_UP = 3
# How soon a thread that waits for Python's lock gets it from another, s.
SWITCH_INTERVAL = 1e-4
# Work that holds nobody up, bytes to compress, and the share that it seems to hold where the second
# core is busy.
FREE_WORK, BUSY = bytes(np.random.default_rng(0).integers(0, 255, 2_000_000, np.uint8)), 0.15
Frame = tuple[NDArray[np.uint8], int]


@dataclass
class Times:
    """Times of a stage, s, one per frame and round, and how much of a round it held others up."""

    frames: list[float] = field(default_factory=list)
    rounds: list[float] = field(default_factory=list)
    held: list[float] = field(default_factory=list)

    @property
    def held_share(self) -> float:
        """Least share of a round; NaN where it was not looked at."""
        shares = [held / own for held, own in zip(self.held, self.rounds, strict=True) if own > 0]
        return min(max(min(shares), 0.0), 1.0) if shares else float("nan")


class Competitor:
    """A thread that does nothing but Python; `time` is what it got of a processor so far, s."""

    def __init__(self) -> None:
        self.time = 0.0
        self._stop = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._interval = sys.getswitchinterval()

    def __enter__(self) -> Competitor:
        sys.setswitchinterval(SWITCH_INTERVAL)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._thread.join()
        sys.setswitchinterval(self._interval)

    def _run(self) -> None:
        while not self._stop:
            self.time = time.thread_time()


class Clock:
    """Takes the time of parts by name."""

    def __init__(self, competitor: Competitor | None = None) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.held: dict[str, float] = defaultdict(float)
        self._competitor = competitor

    @contextmanager
    def part(self, name: str) -> Iterator[list[str]]:
        """Time what is within; it may put another name into what it is given."""
        names = [name]
        rival = self._competitor
        before = 0.0 if rival is None else rival.time
        began, own = time.perf_counter(), time.thread_time()
        yield names
        # Another's work on the machine does not count.
        own, took = time.thread_time() - own, time.perf_counter() - began
        self.seconds[names[-1]].append(own)
        if rival is not None:
            self.held[names[-1]] += took - (rival.time - before)


class Chain:
    """The stages of a sensor, one after the other on one thread, with messages between them."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._sensor, self._rig = sensor, StereoRig(sensor)
        self._trackers = {name: GridTracker(sensor, name) for name in self._rig.views}
        self._reference = Reference.nominal(sensor)
        self._force = ForceStage(sensor)
        self._header = Header()

    def reset(self) -> None:
        """As after start-up."""
        for tracker in self._trackers.values():
            tracker.reset()
        self._force.reset()

    def run(self, frame: Frame, clock: Clock) -> None:
        """Take a frame through all stages."""
        image, stamp_ns = frame
        grids = {}
        for name, view in self._rig.views.items():
            with clock.part("splitting"):
                cut = split_frame(image, view.placement)
            with clock.part(PEER):
                grids[name] = self._trackers[name].track(cut)
            self._messages(clock, "grid", grids[name], self._sensor.pattern.shape)
        with clock.part("triangulation"):
            markers = self._rig.triangulate(grids.get("left"), grids.get("right"))
        with clock.part("displacement"):
            surface = self._reference.surface(markers)
        self._messages(clock, "surface", surface, self._sensor.pattern.shape)
        with clock.part("force, no contact") as names:
            force = self._force.process(surface, stamp_ns)
            if force.contacts:
                names.append("force, contact")
        self._messages(clock, "force_field", force)

    def _messages(self, clock: Clock, name: str, value: object, *shape: object) -> None:
        write: Callable[..., Any] = getattr(conversions, f"{name}_to_msg")
        read: Callable[..., Any] = getattr(reading, f"{name}_from_msg")
        with clock.part(f"{name}: message"):
            message = write(value, self._header)
        with clock.part(f"{name}: read"):
            read(message, *shape)


def measure(chain: Chain, frames: Sequence[Frame], rounds: int) -> dict[str, Times]:
    """Times of all stages over so many rounds, in turn without and with a competitor."""
    found: dict[str, Times] = defaultdict(Times)
    for _ in range(rounds):
        for name, seconds in _round(chain, frames, Clock()).seconds.items():
            found[name].frames += seconds
        with Competitor() as competitor:
            alone = _is_alone(competitor)
            clock = _round(chain, frames, Clock(competitor))
            alone = alone and _is_alone(competitor)
        for name, held in clock.held.items() if alone else ():
            found[name].held.append(held)
            found[name].rounds.append(sum(clock.seconds[name]))
    return found


def _is_alone(competitor: Competitor) -> bool:
    """Whether a thread that holds nobody up leaves the competitor a core of its own."""
    clock = Clock(competitor)
    with clock.part(""):
        zlib.compress(FREE_WORK)
    return clock.held[""] < BUSY * sum(clock.seconds[""])


def _round(chain: Chain, frames: Sequence[Frame], clock: Clock) -> Clock:
    chain.reset()
    for number, frame in enumerate(frames):
        chain.run(frame, Clock() if number < WARM_UP else clock)
    return clock


def recorded_frames(name: str) -> tuple[SensorDescription, list[Frame]]:
    """Sensor and frames of a packaged scene or of a recording."""
    recording = find_recording(name)
    played = open_recording(recording.bag, topic="", frame_rate=30, frame_id="", expected_size=None)
    frames = [item for item in played.messages() if isinstance(item, RecordedFrame)]
    sensor = SensorDescription.load(recording.sensor)
    return sensor, [(item.image, item.stamp_ns) for item in frames]


def table_of(found: dict[str, Times], title: str) -> Table:
    """Times as ratios to tracking a view, and in ms of this machine."""
    table = Table("stage", "median / tracking", "99 % / tracking", "held", "median ms", title=title)
    peer = float(np.median(found[PEER].frames))
    for name, times in found.items():
        median, most = np.percentile(times.frames, [50, 99])
        share = times.held_share
        data = "-" if np.isnan(share) else f"{share:.0%}"
        ratios = f"{median / peer:.3f}", f"{most / peer:.3f}"
        table.add_row(name, *ratios, data, f"{1e3 * median:.2f}")
    return table


def main() -> None:
    """Measure and print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recording", default="grasp", help="scene or bag (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="(%(default)d)")
    parser.add_argument("--model", choices=("linear", "neo_hookean"), help="of the gel")
    arguments = parser.parse_args()
    sensor, frames = recorded_frames(arguments.recording)
    if arguments.model:
        sensor = replace(sensor, elastomer=replace(sensor.elastomer, model=arguments.model))
    found = measure(Chain(sensor), frames, arguments.rounds)
    title = f"Stages over {arguments.recording}, processor time; tracking one view is 1"
    Console().print(table_of(found, title))


if __name__ == "__main__":
    main()
