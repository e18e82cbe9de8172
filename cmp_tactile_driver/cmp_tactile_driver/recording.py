"""What can be replayed: a bag, or a folder of images with stamps made up from a frame rate."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from cmp_tactile_driver.bag_reader import BagReader
from cmp_tactile_driver.bag_storage import STORAGE_SUFFIXES
from cmp_tactile_driver.frame_source import ImageSize, SourceHealth
from cmp_tactile_driver.image_folder import ImageFolder, image_files
from cmp_tactile_driver.recorded_message import (
    WHOLE,
    RecordedCalibration,
    RecordedFrame,
    RecordedMessage,
    TimeSpan,
)

__all__ = ["FolderRecording", "PlayableRecording", "Recording", "open_recording", "split_inputs"]


class Recording(Protocol):
    """Messages in the order of their recording; can be read several times."""

    @property
    def name(self) -> str:
        """What it is, for messages."""

    @property
    def has_camera_info(self) -> bool:
        """Whether camera infos are among the messages."""

    @property
    def health(self) -> SourceHealth:
        """What was lost in the last reading so far."""

    def calibration(self) -> RecordedCalibration | None:
        """What the recorded camera infos say; None where there are none."""

    def messages(self) -> Iterator[RecordedMessage]:
        """The messages from the beginning; bad ones are skipped and counted.

        Raises FrameSourceError where not one frame is good.
        """


class PlayableRecording(Recording, Protocol):
    """A recording of which a part may be read."""

    @property
    def duration(self) -> float:
        """Time from its beginning to its last message, s."""

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedMessage]:
        """The messages of a part, as those of the whole."""


class FolderRecording:
    """A folder of images in natural order: frame k has the stamp k / frame_rate."""

    has_camera_info = False

    def __init__(
        self, folder: Path, frame_rate: float, frame_id: str, expected_size: ImageSize | None
    ) -> None:
        """Raises FrameSourceError for an absent folder and one without images."""
        self._folder = folder
        self._frame_rate = frame_rate
        self._frame_id = frame_id
        self._expected_size = expected_size
        self._source = self._open()

    @property
    def name(self) -> str:
        """The folder."""
        return str(self._folder)

    @property
    def health(self) -> SourceHealth:
        """Images that could not be used in the last reading."""
        return self._source.health

    def calibration(self) -> RecordedCalibration | None:
        """None: images alone do not tell."""
        return None

    @property
    def duration(self) -> float:
        """Time of the last image, s."""
        return (len(image_files(self._folder)) - 1) / self._frame_rate

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedMessage]:
        """The good images; FrameSourceError where there is none."""
        self._source = self._open()
        first_ns, before_ns = span.in_ns(0)
        count = 0
        while (frame := self._source.read()) is not None:
            # A bad image leaves a gap, as a lost frame does.
            number = count + self._source.health.bad_frames
            stamp_ns = round(number * 1e9 / self._frame_rate)
            if before_ns is not None and stamp_ns >= before_ns:
                return
            if stamp_ns >= first_ns:
                yield RecordedFrame(stamp_ns, stamp_ns, self._frame_id, frame.image)
            count += 1

    def _open(self) -> ImageFolder:
        return ImageFolder(self._folder, self._frame_rate, expected_size=self._expected_size)


def split_inputs(text: str) -> list[Path]:
    """The recordings that a text names, separated as the folders of PATH are."""
    return [Path(part).expanduser() for part in text.split(os.pathsep) if part.strip()]


def open_recording(
    path: Path, *, topic: str, frame_rate: float, frame_id: str, expected_size: ImageSize | None
) -> PlayableRecording:
    """A bag (folder or file) or, where the folder is no bag, a folder of images.

    topic: of the bag's images, empty for the only one.  frame_rate (Hz), frame_id: of an image
    folder.  expected_size: absent for the size of the first image.
    Raises FrameSourceError where there is nothing to replay.
    """
    if path.is_dir() and not _is_bag(path):
        return FolderRecording(path, frame_rate, frame_id, expected_size)
    return BagReader(path, topic, expected_size)


def _is_bag(folder: Path) -> bool:
    if (folder / "metadata.yaml").exists():
        return True
    return any(file.suffix in STORAGE_SUFFIXES and file.is_file() for file in folder.iterdir())
