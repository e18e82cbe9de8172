"""Recordings of every kind, frame by frame: bags, folders of images, single images, videos."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.offline.jobs import Options
from cmp_tactile_driver.bags.reader import BagReader, RecordedFrame
from cmp_tactile_driver.bags.recording import (
    FolderRecording,
    Recording,
    SingleImage,
    open_recording,
)
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import image_files
from cmp_tactile_driver.sources.frames import ImageSize
from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.sensor.yaml_section import read_yaml

__all__ = ["check_first_frame", "declared_frames", "frames_between", "open_input"]

NS_PER_S = 10**9


def open_input(source: Path, options: Options, size: ImageSize) -> Recording:
    """The recording at a path; frames must have the size.

    Raises FrameSourceError where there is nothing to read.
    """
    return open_recording(
        source,
        topic=options.topic,
        frame_rate=options.frame_rate,
        frame_id="",
        expected_size=size,
    )


def check_first_frame(recording: Recording) -> None:
    """Read up to the first good frame, before any work is done for the others.

    Raises FrameSourceError or FrameError where there is none, or the first two have another size.
    """
    for item in recording.messages():
        if isinstance(item, RecordedFrame):
            return


def frames_between(recording: Recording, start_s: float, end_s: float) -> Iterator[RecordedFrame]:
    """The frames recorded from start_s up to end_s, in seconds from the first one.

    Raises FrameSourceError where there is none.
    """
    first_ns: int | None = None
    count, passed_s = 0, 0.0
    for frame in recording.messages():
        if not isinstance(frame, RecordedFrame):
            continue
        first_ns = frame.time_ns if first_ns is None else first_ns
        passed_s = (frame.time_ns - first_ns) / NS_PER_S
        if passed_s > end_s:
            break
        if passed_s >= start_s:
            count += 1
            yield frame
    if not count:
        msg = (
            f"{recording.name}: found no frame from {start_s:g} to {end_s:g} s, "
            f"expected times from 0 to {passed_s:.3f} s"
        )
        raise FrameSourceError(msg)


def declared_frames(recording: Recording, source: Path) -> int | None:
    """Number of frames that a recording claims to have; None where it does not tell."""
    if isinstance(recording, SingleImage):
        return 1
    if isinstance(recording, BagReader):
        return _count_in_metadata(source, recording.image_topic)
    if isinstance(recording, FolderRecording):
        return len(image_files(source))
    return None


def _count_in_metadata(bag: Path, topic: str) -> int | None:
    try:
        topics: Any = read_yaml(bag / "metadata.yaml").raw("rosbag2_bagfile_information")
        for item in topics["topics_with_message_count"]:
            if item["topic_metadata"]["name"] == topic:
                return int(item["message_count"])
    except (DescriptionError, KeyError, TypeError, ValueError):
        # Only the progress bar wants it.
        return None
    return None
