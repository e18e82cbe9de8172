"""What can be replayed: a bag, a video, an image, or a folder of them with stamps made up."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from itertools import count, islice
from pathlib import Path

import numpy as np

from cmp_tactile_driver.bags import calibration, reader, storage, timeline
from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources import files, frames


class ImageRecording:
    """Images or a video: frame k has the stamp k / rate, and there is no calibration."""

    has_camera_info = False
    gaps = ""

    def __init__(
        self, open_source: Callable[[], files.ImageFolder | files.VideoFile], frame_id: str
    ) -> None:
        """Raises FrameSourceError where there is nothing to read."""
        self._open, self._frame_id = open_source, frame_id
        self._source = open_source()
        self.name = self._source.name

    @property
    def health(self) -> frames.SourceHealth:
        """Frames that could not be used in the last reading."""
        return self._source.health

    @property
    def duration(self) -> float:
        """Time of the last frame that is said to be there, s."""
        return max(self._source.declared_frames - 1, 0) / self._source.frame_rate

    @property
    def stated_frames(self) -> int | None:
        """How many frames are said to be there; None where that is not known."""
        return self._source.declared_frames or None

    def calibration(self) -> calibration.RecordedCalibration | None:
        """None: images alone do not have it."""
        return None

    def messages(
        self, span: timeline.TimeSpan = timeline.WHOLE
    ) -> Iterator[reader.RecordedMessage]:
        """The good frames; FrameSourceError where there is none, or of another size."""
        self._source = self._open()
        with closing(self._source) as source:
            for good in count():
                frame = source.read()
                # A bad image leaves a gap, as a lost frame does.
                time_s = (good + source.health.bad_frames) / source.frame_rate
                if frame is None or time_s >= span.end:
                    return
                if time_s in span:
                    stamp_ns = round(time_s * 1e9)
                    times = time_s, stamp_ns, stamp_ns
                    yield reader.RecordedFrame(*times, self._frame_id, frame.image)


Recording = reader.BagReader | ImageRecording


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
    is_image = path.is_file() and path.suffix.lower() in files.IMAGE_SUFFIXES
    if is_image or (path.is_dir() and not is_bag(path)):
        images = partial(files.ImageFolder, path, frame_rate, expected_size=expected_size)
        return ImageRecording(images, frame_id)
    if path.is_file() and path.suffix.lower() not in storage.STORAGE_SUFFIXES:
        return ImageRecording(partial(files.VideoFile, path, expected_size=expected_size), frame_id)
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
        mismatch = calibration.calibration_mismatch(self._bag.calibration(), options.sensor)
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
