#!/usr/bin/env python3
"""The page in a browser: first picture, updates, delay, cost, and its effect on the sensor.

setup/run python3 benchmarks/ros/viewer.py [--json FILE] [--only one two ...] [--minutes 60]

A headless Chromium counts the pictures. A corner of every published surface is lifted by an amount
that encodes its number, and the number is read back from the scene. Without a graphics card,
Chromium draws in software, on the processors of the robot. Therefore costs are measured with
readers: processes that receive everything that the page sends and draw nothing, like a browser on
another machine.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rclpy
import viser
import websockets
from geometry_msgs.msg import WrenchStamped
from playwright.sync_api import sync_playwright
from rclpy.serialization import serialize_message
from real_time import (
    ONE,
    TWO,
    WARM_UP,
    Input,
    busy_s,
    container,
    figures,
    memory_mb,
    running,
    wrenches_of,
)
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from tables import CommandLine

from cmp_tactile_bringup.report.results import find_recording
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_msgs.msg import ForceField, Grid, Surface
from cmp_tactile_processing.pipeline import Pipeline, PipelineResult
from cmp_tactile_processing.processes import python_command
from cmp_tactile_processing.ros.messages.conversions import (
    force_field_to_msg,
    grid_to_msg,
    image_to_msg,
    surface_to_msg,
)
from cmp_tactile_processing.sensor.description import SensorDescription

VIEWER = "cmp_tactile_viewer.nodes.web_viewer"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Mesa's software is twice as fast as Chromium's own, and quickest where the scene alone needs it.
OPTIONS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=gl-egl",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
    "--disable-accelerated-2d-canvas",
]
SIZE: Any = {"width": 1280, "height": 800}
PORT = 8170
URL = f"http://127.0.0.1:{PORT}"
# Frames in contact that are published again and again, and their rate.
FRAMES, RATE_HZ = 24, 60.0
SETTLE_S = 5.0
# Height of the corner that carries the number: above all others, in steps that floats resolve.
LIFT_MM, APART_MM, STEP_MM, NUMBERS = 10.0, 20.0, 0.01, 1000
# Counts pictures in the browser.
COUNT = Path(__file__).with_name("count_pictures.js").read_text(encoding="utf-8")
# A browser is counted when it has said from where it looks.
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, -30.0, 20.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 1000.0,
    "image_height": 800,
    "image_width": 1280,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


@dataclass(frozen=True)
class Processed:
    """A frame with all that the chain makes of it."""

    image: np.ndarray
    result: PipelineResult


class Publisher:
    """Publishes processed frames as sensors of some names, numbered by a lifted corner.

    sent: time at which each number was published last, ms, by sensor.
    """

    def __init__(self, names: Sequence[str], frames: Sequence[Processed]) -> None:
        self._frames = frames
        self._node = rclpy.create_node("frames")
        kinds = {
            "image_raw": Image,
            "left/grid": Grid,
            "right/grid": Grid,
            "surface": Surface,
            "force_field": ForceField,
        }
        self._publishers = [
            {
                topic: self._node.create_publisher(kind, f"/{name}/{topic}", 2)
                for topic, kind in kinds.items()
            }
            for name in names
        ]
        self._wrenches = [
            self._node.create_publisher(WrenchStamped, f"/{name}/wrench", 10) for name in names
        ]
        # Apart from stamp and surface, what is sent is made once.
        self._made = [
            {
                "image_raw": image_to_msg(item.image, "mono8", Header()),
                "left/grid": grid_to_msg(item.result.left, Header()),
                "right/grid": grid_to_msg(item.result.right, Header()),
                "force_field": force_field_to_msg(item.result.force, Header()),
            }
            for item in frames
        ]
        self.sent: list[dict[int, float]] = [{} for _ in names]
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self._ended.set()
        self._thread.join()
        self._node.destroy_node()

    def _run(self) -> None:
        count, due = 0, time.monotonic()
        while not self._ended.wait(max(0.0, due - time.monotonic())):
            now_ns = time.time_ns()
            for sensor in range(len(self._publishers)):
                self._publish(sensor, count, now_ns)
            count, due = count + 1, due + 1 / RATE_HZ

    def _publish(self, sensor: int, count: int, now_ns: int) -> None:
        # There and back, so that no step between two frames is a jump.
        place = abs((count + len(self._frames)) % (2 * len(self._frames) - 1) - len(self._frames))
        place = min(place, len(self._frames) - 1)
        header = Header()
        header.stamp.sec, header.stamp.nanosec = divmod(now_ns, 10**9)
        surface = self._frames[place].result.surface
        position = surface.position.copy()
        number = count % NUMBERS
        position[0, 0, 2] = 1e-3 * (LIFT_MM + sensor * APART_MM + number * STEP_MM)
        messages = self._made[place] | {
            "surface": surface_to_msg(replace(surface, position=position), header)
        }
        self.sent[sensor][number] = now_ns * 1e-6
        self._wrenches[sensor].publish(WrenchStamped(header=header))
        for topic, publisher in self._publishers[sensor].items():
            message = messages[topic]
            message.header = header
            publisher.publish(serialize_message(message))


@cache
def processed(bag: Path) -> list[Processed]:
    """The frames of the contact."""
    pipeline = Pipeline(SensorDescription.load(bag / "sensor.yaml"))
    return [
        Processed(frame.image, pipeline.process(frame.image, frame.stamp_ns))
        for frame in islice(BagReader(bag).frames(), 12, 12 + FRAMES)
    ]


@contextmanager
def viewer(names: Sequence[str], description: Path) -> Iterator[subprocess.Popen[bytes]]:
    """The node in a separate process."""
    given = {
        "sensors": " ".join(f"/{name}" for name in names),
        "sensor_descriptions": ":".join([str(description)] * len(names)),
        "sensor_names": " ".join(names),
        "mounts": ", ".join(f"0 {0.06 * k} 0 0 0 0" for k in range(len(names))),
    }
    words = [word for key, value in given.items() for word in ("-p", f'{key}:="{value}"')]
    command = python_command(VIEWER, "--ros-args", *words, "-p", f"port:={PORT}")
    with running(command) as process:
        _wait_for_page()
        yield process


def _wait_for_page() -> None:
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", PORT), 1.0):
            return
        time.sleep(0.02)


@contextmanager
def readers(count: int) -> Iterator[list[subprocess.Popen[str]]]:
    """Processes that take all that the page sends."""
    with ExitStack() as stack:
        found = []
        for _ in range(count):
            command = [sys.executable, __file__, "--reader"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            stack.callback(process.kill)
            found.append(process)
        yield found


async def read() -> None:
    """Print number and bytes of the messages that come, a line a second."""
    address = URL.replace("http", "ws")
    protocols: Any = [f"viser-v{viser.__version__}"]
    options: Any = {"subprotocols": protocols, "max_size": None}
    async with websockets.connect(address, **options) as socket:
        await socket.send(msgspec.msgpack.encode(CAMERA))
        begin, size, count = time.monotonic(), 0, 0
        async for data in socket:
            size, count = size + len(data), count + 1
            if time.monotonic() - begin >= 1.0:
                print(size, count, flush=True)
                begin, size, count = time.monotonic(), 0, 0


class Browser:
    """Headless Chromium."""

    def __enter__(self) -> Browser:
        program = next(filter(None, map(shutil.which, BROWSERS)), None)
        if program is None:
            sys.exit(f"found none of {', '.join(BROWSERS)}")
        self._driver = sync_playwright().start()
        self._chromium = self._driver.chromium.launch(executable_path=program, args=OPTIONS)
        return self

    def __exit__(self, *_: object) -> None:
        self._chromium.close()
        self._driver.stop()

    def open(self) -> Any:
        """A tab with the page, when the surface is in its scene."""
        tab = self._chromium.new_page(viewport=SIZE)
        tab.add_init_script(f"const LIFT_MM = {LIFT_MM};\n{COUNT}")
        tab.goto(URL)
        tab.wait_for_function("window.points > 300", timeout=60_000)
        return tab


def first_picture(bag: Path) -> dict[str, float]:
    """From the start of the command until the surface is in the browser's scene, s."""
    with Browser() as browser:
        begin = time.monotonic()
        command = python_command(
            "cmp_tactile_bringup.command", "view", str(bag), "--port", str(PORT)
        )
        with running(command):
            _wait_for_page()
            served = time.monotonic()
            browser.open()
            return {"page_s": served - begin, "picture_s": time.monotonic() - begin}


def updates(
    names: Sequence[str], frames: Sequence[Processed], bag: Path, duration_s: float
) -> dict[str, float]:
    """Pictures a second in a browser that draws in software, and the delay of each."""
    with (
        closing(Publisher(names, frames)) as publisher,
        viewer(names, bag / "sensor.yaml") as process,
        Browser() as browser,
    ):
        tab = browser.open()
        tab.wait_for_timeout(1e3 * SETTLE_S)
        tab.evaluate("window.pictures = []")
        busy, begin = busy_s(process.pid), time.monotonic()
        tab.wait_for_timeout(1e3 * duration_s)
        pictures = tab.evaluate("window.pictures")
        cores = (busy_s(process.pid) - busy) / (time.monotonic() - begin)
    rates, delays = [], []
    for sensor, sent in enumerate(publisher.sent):
        shown: dict[tuple[int, float], float] = {}
        for height, moment in pictures:
            number = round((height - LIFT_MM - sensor * APART_MM) / STEP_MM)
            if 0 <= number < NUMBERS and number in sent:
                shown.setdefault((number, sent[number]), moment - sent[number])
        rates.append(len(shown) / duration_s)
        # Of a number that was sent once more since, the delay is not known.
        delays += [delay for delay in shown.values() if delay > 0]
    median, most = np.percentile(delays, [50, 99]) if delays else (np.nan, np.nan)
    return {
        "updates_hz": min(rates),
        "delay_median_ms": float(median),
        "delay_p99_ms": float(most),
        "viewer_cores": cores,
    }


def cost(frames: Sequence[Processed], bag: Path, duration_s: float, count: int) -> dict[str, float]:
    """Of the viewer's process with so many readers, and what the slowest of them gets."""
    with (
        closing(Publisher(ONE, frames)),
        viewer(ONE, bag / "sensor.yaml") as process,
        readers(count) as looking,
    ):
        time.sleep(SETTLE_S)
        busy, begin, memory = busy_s(process.pid), time.monotonic(), memory_mb(process.pid)
        time.sleep(duration_s)
        cores = (busy_s(process.pid) - busy) / (time.monotonic() - begin)
        grown = memory_mb(process.pid) - memory
        got = [_read_lines(item) for item in looking]
    found = {"viewer_cores": cores, "memory_mb": memory + grown, "grown_mb": grown}
    if got:
        slowest = min(got, key=lambda lines: float(np.median(lines[:, 0])))
        found["mb_a_s"] = float(np.median(slowest[:, 0])) * 1e-6
    return found


def _read_lines(reader: subprocess.Popen[str]) -> np.ndarray:
    reader.kill()
    lines = reader.communicate()[0].splitlines()[1:]
    return np.array([[float(word) for word in line.split()] for line in lines if " " in line])


def chain(
    scene: str, rate_hz: float, count: int, *, looked_at: bool, bag: Path
) -> dict[str, float]:
    """Lost frames and latency of one sensor, with the viewer or without."""
    with ExitStack() as stack:
        node = stack.enter_context(wrenches_of(ONE))
        process = stack.enter_context(container(Input.from_name(scene), ONE, rate_hz))
        node.wait_for(WARM_UP, process)
        if looked_at:
            stack.enter_context(viewer(ONE, bag / "sensor.yaml"))
            stack.enter_context(readers(1))
        node.wait_for(node.fewest + WARM_UP, process)
        first = node.fewest
        node.wait_for(first + count, process)
    return figures(node, first)


def cases(options: argparse.Namespace) -> dict[str, Callable[[], dict[str, float]]]:
    """By the key of the JSON file."""
    bag = find_recording(options.input).bag
    made, seconds = partial(processed, bag), options.seconds
    return {
        "first_picture": lambda: first_picture(bag),
        "one": lambda: updates(ONE, made(), bag, seconds),
        "two": lambda: updates(TWO, made(), bag, seconds),
        "nobody": lambda: cost(made(), bag, seconds, count=0),
        "one_reader": lambda: cost(made(), bag, seconds, count=1),
        "five_readers": lambda: cost(made(), bag, seconds, count=5),
        "chain_60": lambda: chain(options.input, 60, 1200, looked_at=False, bag=bag),
        "chain_60_viewed": lambda: chain(options.input, 60, 1200, looked_at=True, bag=bag),
        "chain_30": lambda: chain(options.input, 30, 600, looked_at=False, bag=bag),
        "chain_30_viewed": lambda: chain(options.input, 30, 600, looked_at=True, bag=bag),
        "long": lambda: cost(made(), bag, 60 * options.minutes, count=1),
    }


def _row(key: str, found: Mapping[str, float]) -> str:
    return f"| {key} | " + ", ".join(f"{name} {value:.4g}" for name, value in found.items()) + " |"


def main() -> None:
    """Measure, print, and keep."""
    parser = CommandLine(__doc__.partition("\n")[0])
    parser.option("--input", "packaged scene", "grasp")
    parser.option("--seconds", "length of each case", 20.0)
    parser.option("--minutes", "length of the case `long`", 5.0)
    parser.add_json()
    parser.option("--only", "run only these cases", nargs="+", metavar="KEY")
    parser.option("--reader", argparse.SUPPRESS, False)
    options = parser.parse_args()
    if options.reader:
        asyncio.run(read())
        return
    rclpy.init()
    found = {}
    print("| case | |\n|---|---|")
    for key, run in cases(options).items():
        if key in (options.only or [key]):
            found[key] = run()
            print(_row(key, found[key]), flush=True)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
