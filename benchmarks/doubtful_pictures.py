#!/usr/bin/env python3
"""Does the error bar of a force contain what a camera or a codec does to the pictures?

    setup/run python3 benchmarks/doubtful_pictures.py

A ball presses and is dragged quickly, at 30 Hz.  Rendered are eight pictures for each frame; a
rolling shutter and interlaced fields are put together of their rows.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tables import head, line

from cmp_tactile_driver.bags.images import VideoFile
from cmp_tactile_processing.force.advice import UNUSABLE
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Touch
from hard_frames.contacts import frames_of_ball

Images = Sequence[NDArray[np.uint8]]
RATE_HZ, PICTURES, REST = 30.0, 8, 4
PRESS_FRAMES, DRAG_FRAMES = 3, 6
# Of the ball, m: depth, and way of the drag, at 9 mm/s.
DEPTH_M, DRAG_M, CLEARANCE_M = 0.36e-3, 1.8e-3, 0.05e-3


def moving(sensor: SensorDescription) -> tuple[Images, NDArray[np.float64]]:
    """PICTURES a frame, the first REST frames without contact, and forces (n, 3) N."""
    return frames_of_ball(
        sensor,
        Touch((-8e-4, -8e-4), CLEARANCE_M),
        Phase("rest", REST * PICTURES, Hold()),
        Phase("press", PRESS_FRAMES * PICTURES, MoveBy((0.0, 0.0, -DEPTH_M - CLEARANCE_M))),
        Phase("drag", DRAG_FRAMES * PICTURES, MoveBy((DRAG_M / 2**0.5, DRAG_M / 2**0.5, 0.0))),
    )


def at_once(images: Images) -> Images:
    """What a global shutter shows."""
    return images[PICTURES // 2 :: PICTURES]


def rolling(images: Images) -> Images:
    """Rows one after the other during the whole frame interval."""
    height = len(images[0])
    later = np.arange(height) * PICTURES // height
    rows = np.arange(height)
    starts = range(0, len(images), PICTURES)
    return [np.stack(images[k : k + PICTURES])[later, rows] for k in starts]


def interlaced(images: Images) -> Images:
    """Odd rows half a frame interval after the even ones."""
    found = []
    for k in range(0, len(images), PICTURES):
        both = images[k + PICTURES // 4].copy()
        both[1::2] = images[k + 3 * PICTURES // 4][1::2]
        found.append(both)
    return found


def encoded(codec: str, suffix: str) -> Callable[[Images], Images]:
    """What is left of the frames of a global shutter in a video."""

    def encode(images: Images) -> Images:
        with tempfile.TemporaryDirectory(prefix="video_") as folder:
            path = Path(folder) / f"video{suffix}"
            height, width = images[0].shape
            code = cv2.VideoWriter.fourcc(*codec)
            writer = cv2.VideoWriter(str(path), code, RATE_HZ, (width, height), isColor=False)
            for image in at_once(images):
                writer.write(image)
            writer.release()
            return [image for _, image in VideoFile(path).images()]

    return encode


def rows() -> Iterator[str]:
    """A row for each way to take the same pictures: of all frames in which the ball moves."""
    rig = load_sensor("sample_rig")
    images, forces = moving(rig)
    truth = forces[PICTURES // 2 :: PICTURES]
    interval = 1 / RATE_HZ
    cases: list[tuple[str, Callable[[Images], Images], float, bool]] = [
        ("global shutter", at_once, 0.0, False),
        ("rolling shutter, not described", rolling, 0.0, False),
        ("rolling shutter, readout_time", rolling, interval, False),
        ("interlaced, not described", interlaced, 0.0, False),
        ("interlaced, readout_time", interlaced, interval / 2, False),
        ("MPEG-4, as images", encoded("mp4v", ".mp4"), 0.0, False),
        ("MPEG-4", encoded("mp4v", ".mp4"), 0.0, True),
        ("VP9", encoded("VP90", ".webm"), 0.0, True),
    ]
    yield head("pictures", "largest error, N", "in random deviations", "in deviations", "usable")
    for name, take, readout, is_encoded in cases:
        sensor = replace(rig, image=replace(rig.image, readout_time=readout))
        yield _row(name, Pipeline(sensor, encoded=is_encoded), take(images), truth)


def _row(name: str, pipeline: Pipeline, images: Images, truth: NDArray[np.float64]) -> str:
    pipeline.set_reference(images[: REST - 1])
    found, usable = [], 0
    for number, (image, force) in enumerate(zip(images, truth, strict=True)):
        field = pipeline.process(image, round(number * 1e9 / RATE_HZ)).force
        if number >= REST:
            off = np.abs(field.wrench[:3] - force)
            stds = (field.random_std[:3], field.wrench_std[:3])
            found.append((off.max(), *((off / std).max() for std in stds)))
            usable += not field.flags & UNUSABLE
    largest, random, deviations = np.max(found, axis=0)
    return line(name, f"{largest:.3f}", f"{random:.1f}", f"{deviations:.1f}",
                f"{usable} of {len(found)}")  # fmt: skip


def main() -> None:
    """Print the table."""
    for text in rows():
        print(text, flush=True)


if __name__ == "__main__":
    main()
