"""Recordings of every kind, frame by frame: bags, folders of images, single images, videos."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.offline.jobs import Options
from cmp_tactile_driver.bag_reader import BagReader
from cmp_tactile_driver.bag_storage import STORAGE_SUFFIXES
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.frame_source import ImageSize, SourceHealth, size_text
from cmp_tactile_driver.image_decoding import decode_file
from cmp_tactile_driver.image_folder import IMAGE_SUFFIXES, image_files
from cmp_tactile_driver.recorded_message import RecordedFrame
from cmp_tactile_driver.recording import FolderRecording, Recording, open_recording
from cmp_tactile_driver.video_file import VideoFile
from cmp_tactile_processing.errors import DescriptionError, FrameError
from cmp_tactile_processing.yaml_section import read_yaml

__all__ = ["declared_frames", "frames_between", "open_input"]

NS_PER_S = 10**9


class SingleImage:
    """One image file as a recording of one frame, with stamp 0."""

    has_camera_info = False
    health = SourceHealth()

    def __init__(self, path: Path, expected_size: ImageSize) -> None:
        self._path = path
        self._expected_size = expected_size

    @property
    def name(self) -> str:
        """The file."""
        return str(self._path)

    def calibration(self) -> None:
        """None: an image alone does not tell."""

    def messages(self) -> Iterator[RecordedFrame]:
        """The image; ImageDecodingError or FrameError where it cannot be used."""
        image = decode_file(self._path)
        size = (image.shape[1], image.shape[0])
        if size != self._expected_size:
            msg = (
                f"{self._path}: found {size_text(size)}, expected {size_text(self._expected_size)}"
            )
            raise FrameError(msg)
        yield RecordedFrame(0, 0, "", image)


class VideoRecording:
    """A video file: frame k has the stamp k / rate, at the file's own rate."""

    has_camera_info = False

    def __init__(self, path: Path, expected_size: ImageSize) -> None:
        """Raises FrameSourceError for a file that is no video."""
        self._path = path
        self._expected_size = expected_size
        self._video = self._open()

    @property
    def name(self) -> str:
        """The file."""
        return str(self._path)

    @property
    def health(self) -> SourceHealth:
        """Frames that could not be decoded in the last reading."""
        return self._video.health

    def calibration(self) -> None:
        """None: a video does not tell."""

    def messages(self) -> Iterator[RecordedFrame]:
        """The frames; FrameSourceError where there is none, or of another size."""
        self._video = self._open()
        try:
            count = 0
            while (frame := self._video.read()) is not None:
                stamp_ns = round(count * NS_PER_S / self._video.frame_rate)
                yield RecordedFrame(stamp_ns, stamp_ns, "", frame.image)
                count += 1
        finally:
            self._video.close()

    def _open(self) -> VideoFile:
        return VideoFile(self._path, expected_size=self._expected_size)


def open_input(source: Path, options: Options, size: ImageSize) -> Recording:
    """The recording at a path; frames must have the size.

    Raises FrameSourceError where there is nothing to read.
    """
    suffix = source.suffix.lower()
    if source.is_file() and suffix in IMAGE_SUFFIXES:
        return SingleImage(source, size)
    if source.is_file() and suffix not in STORAGE_SUFFIXES:
        return VideoRecording(source, size)
    return open_recording(
        source,
        topic=options.topic,
        frame_rate=options.frame_rate,
        frame_id="",
        expected_size=size,
    )


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
