"""Frames that a calibration is made from: of a recording, or of a camera that runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.recordings.library import check_source, recorded_source
from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.recording import open_recording
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import decode_file
from cmp_tactile_driver.sources.frames import ImageSize
from cmp_tactile_processing.geometry.split import to_grey

__all__ = ["FrameSelection", "RecordedFrames", "read_frames", "read_images", "take_frames"]

Frame = NDArray[np.uint8]
# Of a folder of images, which has no stamps.
FOLDER_RATE_HZ = 30.0


@dataclass(frozen=True)
class FrameSelection:
    """count: at most so many frames, None for all.  start_s: leave out what is earlier.

    topic: image topic of a bag, empty for the only one.
    """

    count: int | None = None
    start_s: float = 0.0
    topic: str = ""


@dataclass(frozen=True)
class RecordedFrames:
    """images (H, W) or (H, W, 3) with their stamps.  problem: why some were left out, or empty."""

    images: list[Frame]
    stamps_ns: list[int]
    problem: str = ""


def read_frames(source: Path, selection: FrameSelection, size: ImageSize | None) -> RecordedFrames:
    """Frames of a bag or a folder of images; size: that they must have.

    Raises RecordingError where there is no such source, FrameSourceError where no frame of it can
    be used.
    """
    check_source(source, "a ROS 2 bag, a folder of images")
    recording = open_recording(
        recorded_source(source),
        topic=selection.topic,
        frame_rate=FOLDER_RATE_HZ,
        frame_id="",
        expected_size=size,
    )
    frames = (item for item in recording.messages() if isinstance(item, RecordedFrame))
    chosen = list(islice(_from(frames, selection.start_s), selection.count))
    if not chosen:
        msg = f"{source}: found no frame after {selection.start_s:g} s, expected a longer recording"
        raise FrameSourceError(msg)
    return RecordedFrames(
        [frame.image for frame in chosen],
        [frame.stamp_ns for frame in chosen],
        recording.health.summary,
    )


def _from(frames: Iterator[RecordedFrame], start_s: float) -> Iterator[RecordedFrame]:
    first_ns: int | None = None
    for frame in frames:
        first_ns = frame.stamp_ns if first_ns is None else first_ns
        if frame.stamp_ns - first_ns >= start_s * 1e9:
            yield frame


def read_images(files: Sequence[Path]) -> list[Frame]:
    """Grey images (H, W) of files; FrameError for one that cannot be read."""
    return [to_grey(decode_file(file.expanduser())) for file in files]


def take_frames(
    frames: Iterator[Frame], count: int, on_frame: Callable[[int], None]
) -> list[Frame]:
    """The next `count` frames of a camera; on_frame is called with their number so far."""
    taken: list[Frame] = []
    for frame in islice(frames, count):
        taken.append(frame)
        on_frame(len(taken))
    return taken
