"""Frames from a video file."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.files import DEFAULT_FRAME_RATE, FileSource
from cmp_tactile_driver.sources.frames import Frame, ImageSize, SourceHealth, SourceOptions

__all__ = ["VideoFile"]


class VideoFile(FileSource):
    """A FrameSource that decodes a video file; its frames are BGR."""

    def __init__(
        self,
        path: Path,
        frame_rate: float = 0.0,
        *,
        loop: bool = False,
        expected_size: ImageSize | None = None,
    ) -> None:
        """frame_rate: frames per second, 0 for the file's own.

        Raises FrameSourceError for an absent file, one that is no video, and a wrong size.
        """
        if not path.is_file():
            msg = f"{path}: found no such file, expected a video"
            raise FrameSourceError(msg)
        super().__init__(path, frame_rate, loop=loop, expected_size=expected_size)
        self._capture = self._open()
        own_rate = self._capture.get(cv2.CAP_PROP_FPS)
        sensible = math.isfinite(own_rate) and 0 < own_rate <= 1000
        self._frame_rate = frame_rate or (own_rate if sensible else DEFAULT_FRAME_RATE)
        self._declared_frames = max(0, round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        self._frames_in_pass = 0
        self._ended = False

    @classmethod
    def from_options(cls, options: SourceOptions) -> VideoFile:
        """The source `video` of the driver."""
        path = Path(options.input).expanduser()
        size = options.frame_size
        return cls(path, options.frame_rate, loop=options.loop, expected_size=size)

    @property
    def declared_frames(self) -> int:
        """How many frames the file says that it has; 0 where it does not."""
        return self._declared_frames

    def read(self) -> Frame | None:
        """The next frame, or None at the end.

        Raises FrameSourceError where there is none at all, or its size is wrong.
        """
        if self._ended:
            return None
        good, image = self._capture.read()
        if not good:
            self._note_missing()
            self._ended = not self._loop
            if self._ended:
                return None
            self._capture.release()
            self._capture, self._frames_in_pass = self._open(), 0
            good, image = self._capture.read()
            if not good:
                msg = f"{self._path}: cannot be decoded a second time"
                raise FrameSourceError(msg)
        self._frames_in_pass += 1
        wrong = self._wrong_size((image.shape[1], image.shape[0]))
        if wrong:
            msg = f"{self._path}: {wrong}"
            raise FrameSourceError(msg)
        return Frame(np.asarray(image, np.uint8), f"{self._path.name} [{self._frames_in_pass - 1}]")

    def close(self) -> None:
        """Close the file."""
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            msg = f"{self._path}: found {self._path.stat().st_size} bytes, expected a video"
            raise FrameSourceError(msg)
        return capture

    def _note_missing(self) -> None:
        count = self._frames_in_pass
        if not count:
            msg = f"{self._path}: no frame can be decoded"
            raise FrameSourceError(msg)
        missing = self._declared_frames - count
        if missing > 0:
            text = f"{self._path}: {count} of {self._declared_frames} frames, the rest is damaged"
            self._health = SourceHealth(self._health.bad_frames + missing, text)
