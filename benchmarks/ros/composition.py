#!/usr/bin/env python3
"""What it costs to pass an image from one component of a container to another, and over DDS.

setup/run python3 benchmarks/ros/composition.py
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import rclpy
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_bringup.container.components import ComponentContainer
from cmp_tactile_bringup.graphs.description import Component
from cmp_tactile_processing.ros.messages.conversions import frame_to_msg
from cmp_tactile_processing.ros.messages.reading import image_from_msg
from cmp_tactile_processing.ros.wiring import Finish, Given, Input, WiredNode

SIZE = (768, 1024)
COUNT = 300
ROUNDS = 3
INTERVAL_S = 1 / 60


class Sender(WiredNode):
    """A source of images."""

    built: Sender

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("sender", **node_kwargs)
        Sender.built = self
        publisher = self.create_publisher(Image, "hop", 10)
        self.output = self.add_output(publisher, frame_to_msg, own_thread=True)


class Receiver(WiredNode):
    """Keeps when images arrive."""

    built: Receiver

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__("receiver", **node_kwargs)
        Receiver.built = self
        self.arrivals: list[float] = []
        self.connect_input(Input(self._begin, image_from_msg), Image, "hop", 10)

    def _begin(self, given: Given) -> Finish:
        frame = given.value
        return lambda: self.arrivals.append(time.perf_counter()) if frame.shape == SIZE else None


COMPONENTS: dict[str, Any] = {"Sender": Sender, "Receiver": Receiver}


def hop_rows() -> list[str]:
    """A Markdown table: the best of some rounds of each, in turn."""
    rows: dict[bool, list[tuple[float, float]]] = {True: [], False: []}
    for _ in range(ROUNDS):
        for connected, found in rows.items():
            found.append(_round(connected=connected))
    best = {connected: tuple(np.min(found, axis=0)) for connected, found in rows.items()}
    lines = ["| hop of an image, 1024 x 768 | processor ms | median latency ms |", "|---|---|---|"]
    for connected, name in ((True, "plain call"), (False, "DDS")):
        lines.append(f"| {name} | {best[connected][0]:.2f} | {best[connected][1]:.2f} |")
    ratio = best[True][0] / best[False][0]
    return [*lines, f"| ratio | {ratio:.2f} | {best[True][1] / best[False][1]:.2f} |"]


def _round(*, connected: bool) -> tuple[float, float]:
    """Processor time of a hop and its latency, both in ms, from image to image."""
    context = rclpy.Context()
    context.init(args=[])
    container = ComponentContainer(context, lookup=lambda _, plugin: COMPONENTS[plugin])
    try:
        for plugin in ("Receiver", "Sender"):
            container.load(Component("hop", plugin, namespace="/hops", intra_process=connected))
        return _measure()
    finally:
        container.shutdown()
        context.try_shutdown()


def _measure() -> tuple[float, float]:
    sender, receiver = Sender.built, Receiver.built
    image = np.zeros(SIZE, np.uint8)
    time.sleep(0.5)
    sent, busy = [], time.process_time()
    for _ in range(COUNT):
        sent.append(time.perf_counter())
        sender.output.publish(image, Header())
        time.sleep(INTERVAL_S)
    busy = time.process_time() - busy
    latency = np.array(receiver.arrivals) - np.array(sent[: len(receiver.arrivals)])
    if len(latency) != COUNT:
        msg = f"{len(latency)} of {COUNT} images arrived"
        raise RuntimeError(msg)
    return 1e3 * busy / COUNT, 1e3 * float(np.median(latency))


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__.partition("\n")[0]).parse_args()
    print("\n".join(hop_rows()))


if __name__ == "__main__":
    main()
