#!/usr/bin/env python3
"""A recorded frame by compression: its size, time to write it as the recorder does, and to read.

Frames are those of a packaged scene, with its camera noise. Times are the processor's, means over
all frames in the quickest round; peer: `none`, which copies.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean

from rich.console import Console
from rich.table import Table
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from cmp_tactile_bringup.recordings.simulated import find_recording
from cmp_tactile_driver.bags.reader import BagReader
from cmp_tactile_driver.bags.writer import BagWriter
from cmp_tactile_driver.nodes.recorder import frame_encoder, message_encoder
from cmp_tactile_driver.sources.parameters import COMPRESSIONS, RecorderParameters
from cmp_tactile_processing.ros.messages.conversions import image_to_msg

TOPIC, KIND = "/sensor/image_raw", "sensor_msgs/msg/Image"
FRAME_NS = 16_666_667
MEGABYTE = 1e6


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table with a row for each compression."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="grasp", help="packaged scene (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=40, help="(default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    recorded = BagReader(find_recording(arguments.scene).bag).frames()
    frames = [item.image for item, _ in zip(recorded, range(arguments.frames), strict=False)]
    header = Header(frame_id="sensor_camera_optical_frame")
    messages = [image_to_msg(image, "mono8", header) for image in frames]
    title = (
        f"{len(frames)} frames of {arguments.scene}, {frames[0].shape[1]} x {frames[0].shape[0]}"
    )
    table = Table("compression", "write ms", "read ms", "MB", "MB/s at 60 Hz", title=title)
    for compression in COMPRESSIONS:
        rounds = [_one(compression, messages) for _ in range(arguments.rounds)]
        write, read = (min(mean(row[k]) for row in rounds) * 1e3 for k in (0, 1))
        size = rounds[0][2] / MEGABYTE
        table.add_row(compression, f"{write:.1f}", f"{read:.1f}", f"{size:.2f}", f"{60 * size:.0f}")
    Console().print(table)
    return 0


def _one(compression: str, messages: Sequence[Image]) -> tuple[list[float], list[float], float]:
    """Seconds to write and to read each frame, and bytes per frame."""
    quality = RecorderParameters.jpeg_quality
    if compression in ("png", "jpeg"):
        encode = frame_encoder(TOPIC, compression, quality)
    else:
        encode = message_encoder(TOPIC, KIND)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with BagWriter(bag, compressed=compression == "zstd") as writer:

            def write(number: int) -> None:
                item = encode(messages[number])
                writer.add_topic(item.topic, item.kind)
                writer.write(item.topic, (number + 1) * FRAME_NS, item.data, item.stamp_ns)

            written = [_timed(lambda n=n: write(n)) for n in range(len(messages))]
        size = sum(path.stat().st_size for path in bag.glob("*.mcap")) / len(messages)
        frames = BagReader(bag).frames()
        read = [_timed(lambda: next(frames)) for _ in messages]
    return written, read, size


def _timed(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin


if __name__ == "__main__":
    sys.exit(main())
