"""What can be replayed: a bag, a video, an image, or a folder of them with stamps made up."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import count, islice
from pathlib import Path
from typing import Protocol

import numpy as np

from cmp_tactile_driver.bags import reader, storage, timeline
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources import files, frames
from cmp_tactile_processing.errors import FrameError


class Recording(Protocol):
    """Messages in the order of their recording; can be read several times.

    name: what it is, for messages.
    """

    name: str

    @property
    def has_camera_info(self) -> bool:
        """Whether camera infos are among the messages."""

    @property
    def health(self) -> frames.SourceHealth:
        """What was lost in the last reading so far."""

    @property
    def duration(self) -> float:
        """Time of its last message, s from its first frame."""

    @property
    def gaps(self) -> str:
        """Times of it that are skipped, in one line; empty for none."""

    def calibration(self) -> reader.RecordedCalibration | None:
        """What the recorded camera infos say; None where there are none."""

    def messages(
        self, span: timeline.TimeSpan = timeline.WHOLE
    ) -> Iterator[reader.RecordedMessage]:
        """The messages of a part; bad ones are skipped and counted.

        Raises FrameSourceError where not one frame is good.
        """


class _WithoutStamps:
    """Images or a video: frame k has the stamp k / rate, and there is no calibration."""

    has_camera_info = False
    gaps = ""

    def __init__(self, path: Path, frame_id: str, expected_size: frames.ImageSize | None) -> None:
        """Raises FrameSourceError where there is nothing to read."""
        self.name = str(path)
        self._path, self._frame_id, self._expected_size = path, frame_id, expected_size
        self._source = self._open()

    @property
    def health(self) -> frames.SourceHealth:
        """Frames that could not be used in the last reading."""
        return self._source.health

    def calibration(self) -> reader.RecordedCalibration | None:
        """None: images alone do not have it."""
        return None

    def messages(
        self, span: timeline.TimeSpan = timeline.WHOLE
    ) -> Iterator[reader.RecordedMessage]:
        """The good frames; FrameSourceError where there is none, or of another size."""
        self._source = self._open()
        try:
            for good in count():
                frame = self._source.read()
                # A bad image leaves a gap, as a lost frame does.
                number = good + self._source.health.bad_frames
                time_s = number / self._source.frame_rate
                if frame is None or time_s >= span.end:
                    return
                if time_s in span:
                    stamp_ns = round(time_s * 1e9)
                    times = time_s, stamp_ns, stamp_ns
                    yield reader.RecordedFrame(*times, self._frame_id, frame.image)
        finally:
            self._source.close()

    def _open(self) -> files.ImageFolder | files.VideoFile:
        raise NotImplementedError


class FolderRecording(_WithoutStamps):
    """A folder of images in natural order."""

    def __init__(
        self, path: Path, frame_rate: float, frame_id: str, expected_size: frames.ImageSize | None
    ) -> None:
        """Raises FrameSourceError for an absent folder and one without images."""
        self._frame_rate = frame_rate
        super().__init__(path, frame_id, expected_size)

    @property
    def duration(self) -> float:
        """Time of the last image, s."""
        return (len(files.image_files(self._path)) - 1) / self._frame_rate

    def _open(self) -> files.ImageFolder:
        return files.ImageFolder(self._path, self._frame_rate, expected_size=self._expected_size)


class VideoRecording(_WithoutStamps):
    """A video file, at its own rate."""

    _source: files.VideoFile

    @property
    def duration(self) -> float:
        """Time of the last frame that the file says it has, s."""
        return max(self._source.declared_frames - 1, 0) / self._source.frame_rate

    def _open(self) -> files.VideoFile:
        return files.VideoFile(self._path, expected_size=self._expected_size)


class SingleImage:
    """One image file as a recording of one frame, with stamp 0."""

    has_camera_info = False
    gaps = ""
    health = frames.SourceHealth()
    duration = 0.0

    def __init__(self, path: Path, frame_id: str, expected_size: frames.ImageSize | None) -> None:
        self.name = str(path)
        self._path, self._frame_id, self._expected_size = path, frame_id, expected_size

    def calibration(self) -> reader.RecordedCalibration | None:
        """None: an image alone does not have it."""
        return None

    def messages(
        self, span: timeline.TimeSpan = timeline.WHOLE
    ) -> Iterator[reader.RecordedMessage]:
        """The image; FrameError where it cannot be used."""
        image = files.decode_file(self._path)
        size, expected = (image.shape[1], image.shape[0]), self._expected_size
        if expected is not None and size != expected:
            found = frames.size_text(size)
            msg = f"{self._path}: found {found}, expected {frames.size_text(expected)}"
            raise FrameError(msg)
        if 0.0 in span:
            yield reader.RecordedFrame(0.0, 0, 0, self._frame_id, image)


def split_inputs(text: str) -> list[Path]:
    """The recordings that a text names, separated as the folders of PATH are."""
    return [Path(part).expanduser() for part in text.split(os.pathsep) if part.strip()]


def open_recording(
    path: Path,
    *,
    topic: str,
    frame_rate: float,
    frame_id: str,
    expected_size: frames.ImageSize | None,
) -> Recording:
    """A bag (folder or file), a video, an image or, where the folder is not a bag, its images.

    topic: of the bag's images, empty for the only one.  frame_rate (Hz): of an image folder.
    frame_id: of images and videos.  expected_size: absent for the size of the first image.
    Raises FrameSourceError where there is nothing to replay.
    """
    if path.is_dir() and not is_bag(path):
        return FolderRecording(path, frame_rate, frame_id, expected_size)
    if path.is_file() and path.suffix.lower() in files.IMAGE_SUFFIXES:
        return SingleImage(path, frame_id, expected_size)
    if path.is_file() and path.suffix.lower() not in storage.STORAGE_SUFFIXES:
        return VideoRecording(path, frame_id, expected_size)
    return reader.BagReader(path, topic, expected_size)


def is_bag(folder: Path) -> bool:
    """Whether a folder holds files of a bag, as it may also without its metadata."""
    return (folder / "metadata.yaml").exists() or bool(storage.bag_files(folder))


# Frames of which the times give the rate.
SAMPLE = 20


class RecordedSource:
    """A FrameSource that reads the images of a bag; their stamps are forgotten."""

    def __init__(self, options: frames.SourceOptions) -> None:
        """The source `bag` of the driver.

        Raises FrameSourceError for what is no bag, has no images of the sensor's size, or was
        recorded with another camera.
        """
        self._bag = reader.BagReader(
            Path(options.input).expanduser(), expected_size=options.frame_size
        )
        self.name = self._bag.name
        self._loop = options.loop
        self._past_bad_frames = 0
        mismatch = reader.calibration_mismatch(self._bag.calibration(), options.sensor)
        if mismatch:
            msg = f"{self.name}: {mismatch}"
            raise FrameSourceError(msg)
        self._frame_rate = options.frame_rate or self._recorded_rate()
        self._frames: Iterator[reader.RecordedFrame] = self._bag.frames()

    @property
    def frame_rate(self) -> float:
        """What is asked for, or as recorded."""
        return self._frame_rate

    @property
    def health(self) -> frames.SourceHealth:
        """Frames that could not be used, in all passes."""
        health = self._bag.health
        return frames.SourceHealth(self._past_bad_frames + health.bad_frames, health.problem)

    def read(self) -> frames.Frame | None:
        """The next good frame, or None at the end; FrameSourceError where none is good."""
        frame = next(self._frames, None)
        if frame is None and self._loop:
            self._past_bad_frames += self._bag.health.bad_frames
            self._frames = self._bag.frames()
            frame = next(self._frames, None)
        if frame is None:
            return None
        return frames.Frame(frame.image, f"{self.name} at {frame.time_ns} ns")

    def close(self) -> None:
        """Forget where it was; the bag is open only while it is read."""
        self._frames = iter(())

    def _recorded_rate(self) -> float:
        times_s = [frame.time_s for frame in islice(self._bag.frames(), SAMPLE)]
        interval_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
        return min(1 / interval_s, 1000.0) if interval_s > 0 else files.DEFAULT_FRAME_RATE
