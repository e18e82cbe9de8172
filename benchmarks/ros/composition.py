#!/usr/bin/env python3
"""From frame to wrench in one container: latency, losses, processor time, with and without DDS.

setup/run python3 benchmarks/ros/composition.py [--frames 600] [--rate 60]

A recording of the packaged grasp is published at the rate, stamped as it is, by the camera driver
of a container with all components of a sensor.  This process listens to the wrenches over DDS, as
a gripper's controller does.  The time of a wrench is that at which it arrives here.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_bringup.recordings.simulated import Recording, find_recording
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_driver.sources.frames import encoding_of
from cmp_tactile_processing.ros.intra_process import IntraProcessNode
from cmp_tactile_processing.ros.messages.conversions import header_at, image_to_msg
from cmp_tactile_processing.ros.messages.reading import stamp_ns

SIZE = (768, 1024)
COUNT = 300
ROUNDS = 3
INTERVAL_S = 1 / 60


class Sender(IntraProcessNode):
    """Publishes images when asked to."""

    built: Sender

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("sender", **node_kwargs)
        Sender.built = self
        self.publisher = self.create_publisher(Image, "hop", 10)


class Receiver(IntraProcessNode):
    """Keeps when images arrive."""

    built: Receiver

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("receiver", **node_kwargs)
        Receiver.built = self
        self.arrivals: list[float] = []
        self.create_subscription(Image, "hop", self._arrive, 10)

    def _arrive(self, _image: Image) -> None:
        self.arrivals.append(time.perf_counter())


COMPONENTS: dict[str, Any] = {"Sender": Sender, "Receiver": Receiver}


def hop_rows() -> list[str]:
    """A Markdown table: the best of some rounds of each, in turn."""
    rows: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for _ in range(ROUNDS):
        for handed, found in rows.items():
            found.append(_round(handed=handed))
    best = {handed: tuple(np.min(found, axis=0)) for handed, found in rows.items()}
    lines = ["| hop of an image, 1024 x 768 | processor ms | median latency ms |", "|---|---|---|"]
    for handed, name in ((True, "handed over"), (False, "DDS")):
        lines.append(f"| {name} | {best[handed][0]:.2f} | {best[handed][1]:.2f} |")
    ratio = best[True][0] / best[False][0]
    return [*lines, f"| ratio | {ratio:.2f} | {best[True][1] / best[False][1]:.2f} |"]


def _round(*, handed: bool) -> tuple[float, float]:
    """Processor time of a hop and its latency, both in ms, without making the message."""
    context = rclpy.Context()
    context.init(args=[])
    container = ComponentContainer(context, lookup=lambda _, plugin: COMPONENTS[plugin])
    try:
        for plugin in ("Receiver", "Sender"):
            container.load(Component("hop", plugin, namespace="/hops", intra_process=handed))
        return _measure()
    finally:
        container.shutdown()
        context.try_shutdown()


def _measure() -> tuple[float, float]:
    sender, receiver = Sender.built, Receiver.built
    image = image_to_msg(np.zeros(SIZE, np.uint8), "mono8", Header())
    time.sleep(0.5)
    sent, busy = [], time.process_time()
    for _ in range(COUNT):
        sent.append(time.perf_counter())
        sender.publisher.publish(image)
        time.sleep(INTERVAL_S)
    busy = time.process_time() - busy
    latency = np.array(receiver.arrivals) - np.array(sent[: len(receiver.arrivals)])
    if len(latency) != COUNT:
        msg = f"{len(latency)} of {COUNT} images arrived"
        raise RuntimeError(msg)
    return 1e3 * busy / COUNT, 1e3 * float(np.median(latency))


WORKER = Path(__file__).parent / "composition_worker.py"
# The first start compiles.
SILENCE_S = 300.0
# Frames before the measurement: the first touch makes pages and caches warm.
WARM_UP = 120
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Run:
    """What one container did.  latency_s: of each wrench; lost: frames without a wrench."""

    what: str
    latency_s: np.ndarray
    lost: int
    rate_hz: float
    cores: float
    first_wrench_s: float


class Wrenches(Node):
    """Keeps stamp and time of arrival of the wrenches of some sensors, and the stamps of frames.

    The stamps of frames are those of camera_info, which is sent beside each.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__("wrenches")
        self.seen: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
        self.frames: dict[str, list[int]] = {name: [] for name in names}
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

    def lost(self, name: str, first: int = 0) -> int:
        """Frames without a wrench between the wrenches from the one numbered `first` on."""
        stamps = {stamp for stamp, _ in self.seen[name][first:]}
        begin, end = min(stamps), max(stamps)
        return sum(begin < frame < end and frame not in stamps for frame in self.frames[name])


@contextmanager
def container(
    options: argparse.Namespace, names: Sequence[str], rate: float, *, dds: bool = False
) -> Iterator[subprocess.Popen[bytes]]:
    """A container with a sensor of each name, all of which get the frames of one recording."""
    recording = find_recording(options.input)
    command = [sys.executable, str(WORKER), *(["--dds"] if dds else []), "--names", *names, "--"]
    with tempfile.TemporaryDirectory(prefix="frames_") as folder:
        bag = _plain_frames(recording, Path(folder) / "bag")
        command += [f"input:={bag}", f"sensor:={recording.sensor}", f"frame_rate:={rate}"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        try:
            yield process
        finally:
            process.terminate()
            if process.wait(60) != 0:
                sys.exit(f"the container ended with {process.returncode}")


def _plain_frames(recording: Recording, folder: Path) -> Path:
    """The frames without compression: a camera's frames need not be decoded."""
    with BagWriter(folder) as bag:
        bag.add_topic("/image_raw", "sensor_msgs/msg/Image")
        for frame in BagReader(recording.bag).frames():
            header = header_at(Time(nanoseconds=frame.stamp_ns).to_msg(), frame.frame_id)
            data = serialize_message(image_to_msg(frame.image, encoding_of(frame.image), header))
            bag.write("/image_raw", frame.stamp_ns, data)
    return folder


@dataclass(frozen=True)
class Setting:
    """What is run.  groups: names of the sensors of each container.  rate: of each sensor, Hz."""

    what: str
    groups: tuple[tuple[str, ...], ...]
    rate: float
    dds: bool = False


ONE, TWO, APART = (("sensor",),), (("left_finger", "right_finger"),), (("left",), ("right",))


def _run(options: argparse.Namespace, setting: Setting) -> Run:
    node = Wrenches([name for names in setting.groups for name in names])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    began = time.monotonic()
    try:
        with ExitStack() as stack:
            processes = [
                stack.enter_context(container(options, names, setting.rate, dds=setting.dds))
                for names in setting.groups
            ]
            spin_until(executor, node, 1, *processes)
            first = time.monotonic() - began
            spin_until(executor, node, WARM_UP, *processes)
            start, busy = time.monotonic(), _busy_together_s(processes)
            spin_until(executor, node, node.fewest + options.frames, *processes)
            cores = (_busy_together_s(processes) - busy) / (time.monotonic() - start)
    finally:
        node.destroy_node()
    return _summary(setting.what, node, cores, first)


def _busy_together_s(processes: Sequence[subprocess.Popen[bytes]]) -> float:
    return sum(busy_s(process.pid) for process in processes)


def _summary(what: str, node: Wrenches, cores: float, first: float) -> Run:
    latencies, lost, spans, counts = [], 0, 0.0, 0
    for name, seen in node.seen.items():
        stamps, arrivals = np.array(seen[WARM_UP:]).T
        latencies.append((arrivals - stamps) * 1e-9)
        lost += node.lost(name, WARM_UP)
        spans, counts = spans + np.ptp(stamps) * 1e-9, counts + len(stamps) - 1
    return Run(what, np.concatenate(latencies), lost, counts / spans, cores, first)


def spin_until(
    executor: SingleThreadedExecutor,
    node: Wrenches,
    count: int,
    *processes: subprocess.Popen[bytes],
) -> None:
    """Until each sensor has so many wrenches; ends the program where no more come."""
    come, last = node.fewest, time.monotonic()
    while node.fewest < count:
        executor.spin_once(timeout_sec=0.5)
        if node.fewest > come:
            come, last = node.fewest, time.monotonic()
        ended = [process.poll() for process in processes if process.poll() is not None]
        if ended or time.monotonic() - last > SILENCE_S:
            sys.exit(f"{node.fewest} wrenches, expected {count}; ended containers: {ended}")


def busy_s(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def _row(run: Run) -> str:
    median, p99, worst = 1e3 * np.percentile(run.latency_s, [50, 99, 100])
    sent = run.lost + len(run.latency_s)
    return (
        f"| {run.what} | {run.rate_hz:.1f} | {run.lost} of {sent} | {median:.1f} | "
        f"{p99:.1f} | {worst:.1f} | {run.cores:.2f} | {run.first_wrench_s:.1f} |"
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rate", type=float, default=60.0)
    parser.add_argument("--input", default="grasp", help="recording, or packaged scene")
    parser.add_argument("--only", choices=("hops", "chain"), help="one of both tables")
    options = parser.parse_args()
    rclpy.init()
    if options.only != "chain":
        print("\n".join(hop_rows()), "\n")
    if options.only != "hops":
        print("| container | Hz | lost | median ms | p99 ms | worst ms | cores | first wrench s |")
        print("|---|---|---|---|---|---|---|---|")
        for setting in (
            Setting("one sensor, intra-process", ONE, options.rate),
            Setting("one sensor, DDS", ONE, options.rate, dds=True),
            Setting("two sensors, intra-process", TWO, options.rate / 2),
            Setting("two sensors, a container each", APART, options.rate / 2),
        ):
            print(_row(_run(options, setting)), flush=True)
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
