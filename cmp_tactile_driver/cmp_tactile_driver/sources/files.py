"""Frames from folders of images and from videos."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import FrameSourceError, WrongSizeError
from cmp_tactile_driver.sources import frames
from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.image.compressed import decode_image
from cmp_tactile_processing.image.raw import BitDepth


def decode_file(path: Path, depth: BitDepth | None = None) -> NDArray[np.uint8]:
    """The image of a file: (H, W) where it is grey, otherwise (H, W, 3) BGR, uint8.

    depth: of the images that the file is one of; absent for one by itself.
    Raises FrameError naming the file.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror}"
        raise FrameError(msg) from None
    return decode_image(content, str(path), depth)


DEFAULT_FRAME_RATE = 30.0
"""Of files that do not have theirs, Hz."""


class FileSource:
    """Name, rate, health and frame size of a FrameSource that reads a file or folder.

    frame_rate: frames per second.  health: frames that could not be used.
    """

    def __init__(
        self, path: Path, frame_rate: float, *, loop: bool, expected_size: frames.ImageSize | None
    ) -> None:
        """expected_size: where absent, the size of the first frame that is compared."""
        self._path = path
        self.frame_rate = frame_rate
        self._loop = loop
        self._expected_size = expected_size
        self.health = frames.SourceHealth()

    @property
    def name(self) -> str:
        """The file or folder."""
        return str(self._path)

    def _wrong_size(self, size: frames.ImageSize) -> str:
        """What was found and expected; empty where the size is right."""
        self._expected_size = self._expected_size or size
        if size == self._expected_size:
            return ""
        return f"found {frames.size_text(size)}, expected {frames.size_text(self._expected_size)}"


IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")

VIDEO_SUFFIXES = (
    ".avi",
    ".m4v",
    ".mjpeg",
    ".mkv",
    ".mov",
    ".mp4",
    ".mpeg",
    ".mpg",
    ".webm",
    ".wmv",
)


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order: 2.png before 10.png; hidden files are none.

    An image by itself is its own folder.
    Raises FrameSourceError where there is no such folder or no image in it.
    """
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        msg = f"{folder}: found no such folder, expected one with images"
        raise FrameSourceError(msg)
    # macOS leaves ._NAME.png beside NAME.png on the disks of others.
    there = [path for path in folder.iterdir() if not path.name.startswith(".")]
    files = [path for path in there if path.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        expected = ", ".join(IMAGE_SUFFIXES)
        msg = f"{folder}: found no image among {len(there)} entries, expected {expected}"
        raise FrameSourceError(msg)
    return sorted(files, key=_natural_key)


class ImageFolder(FileSource):
    """A FrameSource that reads the images of a folder in natural order, or one image.

    Where they have 16 bits a pixel, all are read ahead once for the bits that they use.

    declared_frames: how many images there are.
    """

    def __init__(
        self,
        folder: Path,
        frame_rate: float,
        *,
        loop: bool = False,
        expected_size: frames.ImageSize | None = None,
    ) -> None:
        """expected_size: where absent, the size of the first good image.

        Raises FrameSourceError for an absent folder and one without images.
        """
        super().__init__(folder, frame_rate, loop=loop, expected_size=expected_size)
        self._files = image_files(folder)
        self.declared_frames = len(self._files)
        self._depth = BitDepth(str(folder), look_ahead=self._used_bits)
        self._next = 0
        self._good_in_pass = 0
        self._wrong_sizes = 0

    @classmethod
    def from_options(cls, options: frames.SourceOptions) -> ImageFolder:
        """The source `images` of the driver."""
        return cls(
            Path(options.input).expanduser(),
            options.frame_rate or DEFAULT_FRAME_RATE,
            loop=options.loop,
            expected_size=options.frame_size,
        )

    def read(self) -> frames.Frame | None:
        """The next good image, or None at the end.

        Raises FrameSourceError where none of the images is good.
        """
        while True:
            if self._next == len(self._files) and not self._start_over():
                return None
            path = self._files[self._next]
            self._next += 1
            try:
                image = self._load(path)
            except FrameError as error:
                self.health = self.health.with_bad_frame(str(error))
                if not self._good_in_pass and isinstance(error, WrongSizeError):
                    self._wrong_sizes += 1
                if self._wrong_sizes == frames.MOST_WRONG_SIZES:
                    raise self._none_good(self._next) from None
                continue
            self._good_in_pass += 1
            return frames.Frame(image, path.name)

    def close(self) -> None:
        """Nothing to give back: files are open only while they are read."""

    def _start_over(self) -> bool:
        if not self._good_in_pass:
            raise self._none_good(len(self._files))
        if self._loop:
            self._next = self._good_in_pass = self._wrong_sizes = 0
        return self._loop

    def _none_good(self, count: int) -> FrameSourceError:
        first = "" if count == len(self._files) else f"the first {count} of "
        which = f"none of {first}{len(self._files)} images is good"
        return FrameSourceError(f"{self._path}: {which}, last: {self.health.problem}")

    def _used_bits(self) -> int:
        depth = BitDepth(say=str)
        for path in self._files:
            with suppress(FrameError):
                decode_file(path, depth)
        return depth.bits

    def _load(self, path: Path) -> NDArray[np.uint8]:
        image = decode_file(path, self._depth)
        wrong = self._wrong_size((image.shape[1], image.shape[0]))
        if wrong:
            msg = f"{path}: {wrong}"
            raise WrongSizeError(msg)
        return image


def _natural_key(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts], path.name


class VideoFile(FileSource):
    """A FrameSource that decodes a video file; its frames are BGR.

    declared_frames: how many frames the file says that it has; 0 where it does not.
    """

    def __init__(
        self,
        path: Path,
        frame_rate: float = 0.0,
        *,
        loop: bool = False,
        expected_size: frames.ImageSize | None = None,
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
        self.frame_rate = frame_rate or (own_rate if sensible else DEFAULT_FRAME_RATE)
        self.declared_frames = max(0, round(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        self._frames_in_pass = 0
        self._ended = False

    @classmethod
    def from_options(cls, options: frames.SourceOptions) -> VideoFile:
        """The source `video` of the driver."""
        path = Path(options.input).expanduser()
        size = options.frame_size
        return cls(path, options.frame_rate, loop=options.loop, expected_size=size)

    def read(self) -> frames.Frame | None:
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
        return frames.Frame(
            np.asarray(image, np.uint8), f"{self._path.name} [{self._frames_in_pass - 1}]"
        )

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
        missing = self.declared_frames - count
        if missing > 0:
            text = f"{self._path}: {count} of {self.declared_frames} frames, the rest is damaged"
            self.health = frames.SourceHealth(self.health.bad_frames + missing, text)
