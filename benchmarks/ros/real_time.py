#!/usr/bin/env python3
"""Live sensors at 30 to 200 Hz: latency to the wrench, losses, processor time, memory, start.

setup/run python3 benchmarks/ros/real_time.py [--json FILE] [--input ...] [--only one_60 ...]
setup/run python3 benchmarks/ros/real_time.py --soak 60   # minutes of one sensor at 60 Hz

The sensors of the graph in cameras.py run as with `standalone` and the launch files: one process
for each, and the newest frame is processed. The camera driver of each sensor publishes a recording
at the rate, with the present time as stamp. This process subscribes to the wrenches over DDS, like
the controller of a gripper, and takes the time of their arrival. The container adds the difference
of two processor times of a frame: that of the container, with the camera driver, and that of
`Pipeline` in this process, on the same frames at the same rate.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo

sys.path.insert(0, str(Path(__file__).parents[1]))
from inputs import Input, add_options, chosen
from pipeline_speed import BOTH, PEER, Chain, Times, take_peer
from tables import CommandLine, head, keep, line
from tracking.detectors import peers

from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_driver.sources.frames import encoding_of
from cmp_tactile_processing.cache.compiled import use_cache_of_these_sources
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.processes import python_command
from cmp_tactile_processing.ros.messages.conversions import header_at, image_to_msg
from cmp_tactile_processing.ros.messages.reading import stamp_ns

EXECUTABLES = "cmp_tactile_bringup.container.executables"
GRAPH = Path(__file__).parent / "cameras.py"
# What the container adds to `Pipeline` is measured at this rate.
PACE_HZ = 30.0
# The first start compiles.
SILENCE_S = 300.0
# Wrenches before the measurement: the first touch makes pages and caches warm.
WARM_UP = 120
# OpenCV is timed on one frame in so many.
OPENCV_FRAMES = 3
SOAK_HZ, STEADY_WRENCHES = 60.0, 600
PIPELINE = "pipeline"
COLUMNS = ("cores", "MB", "first wrench s", "ms a frame")
LAST = (("cores", 2), ("memory_mb", 0), ("first_wrench_s", 1), ("frame_ms", 1))
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Case:
    """A case.  rate: of each sensor, Hz.  frames: of each sensor; 0: only to the first wrench.

    fresh: with a new home folder, the compiled code and the force models of `make build`.
    """

    names: tuple[str, ...]
    rate: float
    frames: int
    fresh: bool = False


ONE, TWO = ("sensor",), ("left_finger", "right_finger")


def cases(frames: int) -> dict[str, Case]:
    """By the key of the JSON file; the first one makes the caches warm for those after it."""
    return {
        "one_60": Case(ONE, 60, frames),
        "two_60": Case(TWO, 60, frames),
        "one_30": Case(ONE, 30, frames),
        "two_30": Case(TWO, 30, frames),
        "one_100": Case(ONE, 100, frames),
        "overload": Case(ONE, 200, frames),
        "start_warm": Case(ONE, 30, 0),
        "start_built": Case(ONE, 30, 0, fresh=True),
    }


class Wrenches(Node):
    """Keeps stamp and time of arrival of the wrenches of some sensors, and the stamps of frames.

    The stamps of the frames come from camera_info, which is sent with each frame.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__("wrenches")
        self.seen: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
        self.frames: dict[str, list[int]] = {name: [] for name in names}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        profile = QoSProfile(depth=1000)
        for name in names:
            seen, frames = self.seen[name], self.frames[name]

            def arrive(message: WrenchStamped, seen: list[tuple[int, int]] = seen) -> None:
                seen.append((stamp_ns(message.header.stamp), time.time_ns()))

            def taken(message: CameraInfo, frames: list[int] = frames) -> None:
                frames.append(stamp_ns(message.header.stamp))

            self.create_subscription(WrenchStamped, f"/{name}/wrench", arrive, profile)
            self.create_subscription(CameraInfo, f"/{name}/camera_info", taken, profile)

    @property
    def fewest(self) -> int:
        """Wrenches of the sensor that has the fewest."""
        return min(len(seen) for seen in self.seen.values())

    def wait_for(self, count: int, process: subprocess.Popen[bytes]) -> None:
        """Until each sensor has so many; ends the program where no more come."""
        come, last = self.fewest, time.monotonic()
        while self.fewest < count:
            self._executor.spin_once(timeout_sec=0.5)
            if self.fewest > come:
                come, last = self.fewest, time.monotonic()
            if process.poll() is not None or time.monotonic() - last > SILENCE_S:
                ended = f"exit code of the container: {process.poll()}"
                sys.exit(f"{self.fewest} wrenches, expected {count}; {ended}")

    def lost(self, name: str, first: int) -> int:
        """Frames without a wrench between the wrenches from the one numbered `first` on."""
        stamps = {stamp for stamp, _ in self.seen[name][first:]}
        begin, end = min(stamps), max(stamps)
        return sum(begin < frame < end and frame not in stamps for frame in self.frames[name])


@contextmanager
def container(
    recording: Input,
    names: Sequence[str],
    rate: float,
    environment: Mapping[str, str] | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    """Sensors of these names; each gets the frames of the recording."""
    with tempfile.TemporaryDirectory(prefix="frames_") as folder:
        bag = _plain_frames(recording, Path(folder) / "bag")
        given = {"input": bag, "sensor": recording.sensor_file, "names": " ".join(names)}
        given["frame_rate"] = rate
        arguments = [f"{name}:={value}" for name, value in given.items()]
        command = python_command(EXECUTABLES, "standalone", str(GRAPH), *arguments)
        with running(command, {**os.environ, **(environment or {})}) as process:
            yield process
        if process.returncode != 0:
            sys.exit(f"the container ended with {process.returncode}")


@contextmanager
def running(
    command: Sequence[str], environment: Mapping[str, str] | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """A process that prints nothing here, and is ended at last."""
    silent = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=silent, stderr=silent, env=environment)
    try:
        yield process
    finally:
        process.terminate()
        process.wait(60)


@contextmanager
def wrenches_of(names: Sequence[str]) -> Iterator[Wrenches]:
    """What subscribes to these sensors."""
    node = Wrenches(names)
    try:
        yield node
    finally:
        node.destroy_node()


def _plain_frames(recording: Input, folder: Path) -> Path:
    """The frames without compression: a camera's frames need not be decoded."""
    with BagWriter(folder) as bag:
        bag.add_topic("/image_raw", "sensor_msgs/msg/Image")
        for image, stamp in recording.frames():
            header = header_at(Time(nanoseconds=stamp).to_msg(), "camera")
            data = serialize_message(image_to_msg(image, encoding_of(image), header))
            bag.write("/image_raw", stamp, data)
    return folder


def busy_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def tree(pid: int) -> list[int]:
    """A process and all that it started."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += tree(int(child))
    return found


def memory_mb(pid: int) -> float:
    """Memory of a process, with its part of what it shares."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return float(text.partition("\nPss:")[2].split()[0]) / 1024


def run(recording: Input, case: Case) -> dict[str, float]:
    """The figures of a case."""
    with (
        wrenches_of(case.names) as node,
        tempfile.TemporaryDirectory(prefix="home_") as home,
        container(
            recording, case.names, case.rate, _fresh(home) if case.fresh else None
        ) as process,
    ):
        began = time.monotonic()
        node.wait_for(1, process)
        first = time.monotonic() - began
        if not case.frames:
            return {"first_wrench_s": first}
        node.wait_for(WARM_UP, process)
        start, busy = time.monotonic(), _busy_together_s(process.pid)
        node.wait_for(node.fewest + case.frames, process)
        cores = (_busy_together_s(process.pid) - busy) / (time.monotonic() - start)
        memory = max(memory_mb(pid) for pid in tree(process.pid))
    return {**figures(node), "cores": cores, "memory_mb": memory, "first_wrench_s": first}


def soak(recording: Input, minutes: float) -> dict[str, dict[str, float]]:
    """What one sensor's process loses, and holds at the start and the end of so many minutes."""
    with wrenches_of(ONE) as node, container(recording, ONE, SOAK_HZ) as process:
        node.wait_for(STEADY_WRENCHES, process)
        start, end = holds(process.pid, "start"), time.monotonic() + 60 * minutes
        while time.monotonic() < end:
            node.wait_for(node.fewest + 1, process)
        found = {**figures(node, STEADY_WRENCHES), **start, **holds(process.pid, "end")}
    for name, value in found.items():
        print(f"{name:18} {value:10.1f}")
    return {"soak": found}


def holds(pid: int, when: str) -> dict[str, float]:
    """Memory in MB, threads and open files of a process and all that it started."""
    found = {"memory_mb": 0.0, "threads": 0.0, "handles": 0.0}
    for item in tree(pid):
        found["memory_mb"] += memory_mb(item)
        for name, folder in (("threads", "task"), ("handles", "fd")):
            found[name] += len(list(Path(f"/proc/{item}/{folder}").iterdir()))
    return {f"{name}_{when}": value for name, value in found.items()}


def beside(recording: Input, rate: float) -> dict[str, float]:
    """Processor time of a frame, ms: of OpenCV on both views, and of `Pipeline` at the rate.

    Means over the recording's frames, as the container has them.
    """
    chain, times = Chain(recording.sensor), Times()
    pipeline, frames = Pipeline(recording.sensor), list(recording.frames())
    for counted in (Times(), times):
        due = time.monotonic()
        for image, stamp in frames:
            counted.take(PIPELINE, pipeline.process, image, stamp, clock=time.process_time)
            due += 1 / rate
            time.sleep(max(due - time.monotonic(), 0.0))
    for image, _ in frames[::OPENCV_FRAMES]:
        views = chain.views(image)
        grids = {name: chain.trackers[name].track(cut) for name, cut in views.items()}
        take_peer(peers()[0], recording.sensor, views, grids, times)
    means = {name: 1e3 * float(np.mean(values)) for name, values in times.found.items()}
    return {"opencv_ms": means[PEER + BOTH], "pipeline_ms": means[PIPELINE]}


def _fresh(home: str) -> dict[str, str]:
    use_cache_of_these_sources()
    changed = {"XDG_CACHE_HOME": home, "NUMBA_CACHE_DIR": os.environ["NUMBA_CACHE_DIR"]}
    command = python_command("cmp_tactile_processing.prepare", "sample_rig", "--only", "forces")
    subprocess.run(command, env={**os.environ, **changed}, stdout=subprocess.DEVNULL, check=True)
    return changed


def _busy_together_s(pid: int) -> float:
    return sum(busy_s(item) for item in tree(pid))


def figures(node: Wrenches, first: int = WARM_UP) -> dict[str, float]:
    """Losses and latencies of all wrenches from the one numbered `first` on."""
    latencies, lost, span, count = [], 0, 0.0, 0
    for name, seen in node.seen.items():
        stamps, arrivals = np.array(seen[first:]).T
        latencies.append((arrivals - stamps) * 1e-6)
        lost += node.lost(name, first)
        span, count = span + np.ptp(stamps) * 1e-9, count + len(stamps) - 1
    median, most, worst = np.percentile(np.concatenate(latencies), [50, 99, 100])
    return {
        "lost": lost,
        "sent": lost + sum(map(len, latencies)),
        "rate_hz": count / span,
        "median_ms": float(median),
        "p99_ms": float(most),
        "worst_ms": float(worst),
    }


def _row(key: str, found: Mapping[str, float]) -> str:
    if "lost" not in found:
        return line(key, *6 * [""], f"{found['first_wrench_s']:.1f}", "")
    lost = f"{found['lost']:.0f} of {found['sent']:.0f}"
    numbers = [f"{found[name]:.1f}" for name in ("rate_hz", "median_ms", "p99_ms")]
    last = (f"{found[name]:.{digits}f}" for name, digits in LAST)
    return line(key, numbers[0], lost, *numbers[1:], *last)


def _measure(recording: Input, chosen_cases: Mapping[str, Case]) -> dict[str, dict[str, float]]:
    """All cases of a recording, printed one by one; `beside` has the times of the peers."""
    found = {"beside": beside(recording, PACE_HZ)}
    opencv, pipeline = found["beside"].values()
    print(f"\n{recording.name}: OpenCV {opencv:.1f} ms, Pipeline {pipeline:.1f} ms for a frame\n")
    print(head("case", "Hz each", "lost", "median ms", "p99 ms", *COLUMNS))
    for key, case in chosen_cases.items():
        found[key] = run(recording, case)
        if "cores" in found[key]:
            # All sensors together take `cores`.
            frames = found[key]["rate_hz"] * len(case.names)
            found[key]["frame_ms"] = 1e3 * found[key]["cores"] / frames
        print(_row(key, found[key]), flush=True)
    if "one_30" in found:
        found["beside"]["container_adds_ms"] = found["one_30"]["frame_ms"] - pipeline
        print(f"the container adds {found['beside']['container_adds_ms']:.1f} ms to a frame")
    return found


def main() -> None:
    """Measure, print, and keep."""
    parser = CommandLine(__doc__.partition("\n")[0])
    add_options(parser)
    parser.option("--frames", "frames of each sensor", 600)
    parser.add_json()
    parser.option("--only", "run only these cases", nargs="+", choices=cases(1), metavar="KEY")
    parser.option("--soak", "run one sensor at 60 Hz alone", 0.0, metavar="MINUTES")
    options = parser.parse_args()
    rclpy.init()
    wanted = {
        key: case
        for key, case in cases(options.frames).items()
        if key in (options.only or cases(1))
    }
    for recording in chosen(options)[: 1 if options.soak else None]:
        found = soak(recording, options.soak) if options.soak else _measure(recording, wanted)
        if options.json:
            keep(options.json, {recording.name: found})
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
