"""Recordings that are folders of images, one image, or a video."""

from __future__ import annotations

import math
import re
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.storage import foreign_content
from cmp_tactile_driver.bags.timeline import DEFAULT_FRAME_RATE, WHOLE, TimeSpan
from cmp_tactile_driver.sources import frames
from cmp_tactile_processing.errors import FrameError, FrameSourceError
from cmp_tactile_processing.image.encodings import BitDepth, decode_image, not_turned
from cmp_tactile_processing.sensor.description import SensorDescription

WEBP_HEAD_BYTES = 21
HEIF_SUFFIXES = (".heic", ".heif")
_PNG_CHUNK = struct.Struct(">I4sI")

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

# Small movements are not worth bits to them, so that parts of a frame show an earlier one.
CODECS_OF_CHANGES = (
    *("AV01", "AVC1", "DIVX", "DX50", "FMP4", "H264", "HEV1", "HEVC", "HVC1", "MP42", "MP4V"),
    *("MPG1", "MPG2", "VP80", "VP90", "WMV2", "WMV3", "XVID"),
)
# Of videos that state their number of frames.  For others, OpenCV multiplies duration and rate.
COUNTING_SUFFIXES = (".avi", ".m4v", ".mov", ".mp4")
# Matroska and WebM round times to it.
TIME_STEP_S = 1e-3


def decode_file(path: Path, depth: BitDepth | None = None) -> NDArray[np.uint8]:
    """The image of a file: (H, W) where it is grey, otherwise (H, W, 3) BGR, uint8.

    depth: of the images that the file is one of; absent for one by itself.
    Raises FrameError naming the file, also where more images of its size are in it.
    """
    try:
        content = np.fromfile(path, np.uint8)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror}"
        raise FrameError(msg) from None
    if foreign := foreign_content(path):
        msg = f"{path}: {foreign}"
        raise FrameError(msg)
    image = decode_image(content, str(path), depth)
    if _is_animation(content) or _next_shape(content)[:2] == image.shape[:2]:
        msg = f"{path}: found several images in one file, expected one: write each to its own file"
        raise FrameError(msg)
    return image


def _next_shape(content: NDArray[np.uint8]) -> tuple[int, ...]:
    """Of the second image of a TIFF, which is smaller where it is a preview; () for none."""
    if content[:2].tobytes() not in (b"II", b"MM"):
        return ()
    _, images = cv2.imdecodemulti(not_turned(content), cv2.IMREAD_UNCHANGED, range=(1, 2))
    return images[0].shape if images else ()


def _is_animation(content: NDArray[np.uint8]) -> bool:
    """Whether it is a PNG or WebP of several images, which each says before its first."""
    head = content[:WEBP_HEAD_BYTES].tobytes()
    if not head.startswith(b"\x89PNG"):
        return head[8:16] == b"WEBPVP8X" and bool(head[-1] & 2)
    chunk = 8
    while True:
        # Length, name and first number of a chunk; its content may be long.
        length, kind, images = _PNG_CHUNK.unpack(content[chunk : chunk + _PNG_CHUNK.size].tobytes())
        if kind in (b"acTL", b"IDAT"):
            return kind == b"acTL" and images > 1
        chunk += length + 12


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
        heif = next((path for path in there if path.suffix.lower() in HEIF_SUFFIXES), None)
        if heif and (foreign := foreign_content(heif)):
            msg = f"{heif}: {foreign}"
            raise FrameSourceError(msg)
        expected = ", ".join(IMAGE_SUFFIXES)
        msg = f"{folder}: found no image among {len(there)} entries, expected {expected}"
        raise FrameSourceError(msg)
    return sorted(files, key=natural_key)


def natural_key(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    """Puts 2.png before 10.png."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts], path.name


class _Images(ABC):
    """Images or a video: stamps are times from the first frame, and there is no calibration.

    health: frames that could not be used in the last reading.  frame_rate: frames per second.
    declared_frames: how many are said to be there; 0 where that is not said.  frame_id: of all.
    """

    of_surfaces, gaps, codec = False, "", ""
    frame_rate: float
    declared_frames: int

    def __init__(self, path: Path, expected_size: frames.ImageSize | None, frame_id: str) -> None:
        """expected_size: where absent, the size of the first image that is compared."""
        self._path, self.name, self._frame_id = path, str(path), frame_id
        self._expected_size, self._wrong_sizes = expected_size, 0
        self.health = frames.SourceHealth()

    def _wrong_size(self, image: NDArray[np.uint8]) -> str:
        """What was found and expected; empty where the size is right."""
        size = (image.shape[1], image.shape[0])
        self._expected_size = self._expected_size or size
        if size == self._expected_size:
            return ""
        self._wrong_sizes += 1
        return f"found {frames.size_text(size)}, expected {frames.size_text(self._expected_size)}"

    @property
    def duration(self) -> float:
        """Time of the last frame that is said to be there, s."""
        return max(self.declared_frames - 1, 0) / self.frame_rate

    def calibration_mismatch(self, _sensor: SensorDescription) -> str:
        """Nothing: images alone have no calibration."""
        return ""

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedFrame]:
        """The good frames; FrameSourceError where there is none, or of another size."""
        for time_s, image in self.images():
            if time_s >= span.end:
                return
            if time_s in span:
                stamp_ns = round(time_s * 1e9)
                yield RecordedFrame(time_s, stamp_ns, stamp_ns, self._frame_id, image)

    frames = messages

    @abstractmethod
    def images(self) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """Time in s and pixels of the good images, from the first on; others are counted.

        Raises FrameSourceError where there is none.
        """


class ImageFolder(_Images):
    """The images of a folder in natural order, or one image.

    Where they have 16 bits a pixel, all are read ahead once for the bits that they use.
    """

    def __init__(
        self,
        folder: Path,
        frame_rate: float = DEFAULT_FRAME_RATE,
        *,
        expected_size: frames.ImageSize | None = None,
        frame_id: str = "",
        chosen: Sequence[Path] = (),
    ) -> None:
        """expected_size: where absent, the size of the first good image.  chosen: all if empty.

        Raises FrameSourceError for an absent folder and one without images.
        """
        super().__init__(folder, expected_size, frame_id)
        self.frame_rate = frame_rate
        self._files = list(chosen) or image_files(folder)
        self.declared_frames = len(self._files)
        self._depth = BitDepth(str(folder), look_ahead=self._used_bits)

    def images(self) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """As of all images; a bad one leaves a gap, as a lost frame does."""
        self.health = frames.SourceHealth()
        good = self._wrong_sizes = 0
        for number, path in enumerate(self._files):
            try:
                image = self._load(path)
            except FrameError as error:
                self.health = self.health.with_bad_frame(str(error))
                if self._wrong_sizes == frames.MOST_WRONG_SIZES and not good:
                    raise self._none_good(number + 1) from None
                continue
            good += 1
            yield number / self.frame_rate, image
        if not good:
            raise self._none_good(len(self._files))

    def _none_good(self, count: int) -> FrameSourceError:
        if self._files == [self._path]:
            return FrameSourceError(self.health.problem)
        first = "" if count == len(self._files) else f"the first {count} of "
        which = f"none of {first}{len(self._files)} images can be read"
        last = self.health.problem.removeprefix(f"{self._path}/")
        return FrameSourceError(f"{self._path}: {which}, last: {last}")

    def _used_bits(self) -> int:
        depth = BitDepth(say=str)
        for path in self._files:
            with suppress(FrameError):
                decode_file(path, depth)
        return depth.bits

    def _load(self, path: Path) -> NDArray[np.uint8]:
        image = decode_file(path, self._depth)
        wrong = self._wrong_size(image)
        if wrong:
            msg = f"{path}: {wrong}"
            raise FrameError(msg)
        return image


class VideoFile(_Images):
    """The frames of a video file, which are BGR; as the camera made them, not turned for viewing.

    frame_rate: the file's own, frames per second, the mean where it varies.  declared_frames: how
    many frames the file says that it has; 0 where it does not.  codec: its four characters where
    it encodes with loss what changes between frames, else empty.
    """

    def __init__(
        self, path: Path, *, expected_size: frames.ImageSize | None = None, frame_id: str = ""
    ) -> None:
        """Raises FrameSourceError for an absent file and one that is no video."""
        if not path.is_file():
            msg = f"{path}: found no such file, expected a video"
            raise FrameSourceError(msg)
        super().__init__(path, expected_size, frame_id)
        with self._opened() as capture:
            rate = capture.get(cv2.CAP_PROP_FPS)
            self.declared_frames = max(0, round(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
            code = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True)
        codec = code.decode("ascii", "replace")
        self.codec = codec if codec.upper() in CODECS_OF_CHANGES else ""
        sensible = math.isfinite(rate) and 0 < rate <= 1000
        self.frame_rate = rate if sensible else DEFAULT_FRAME_RATE

    def images(self) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """As of all images; FrameSourceError, too, where a size is wrong."""
        self.health = frames.SourceHealth()
        count, first_s, time_s = 0, 0.0, 0.0
        with self._opened() as capture:
            while (read := capture.read())[0]:
                image = np.asarray(read[1], np.uint8)
                wrong = self._wrong_size(image)
                if wrong:
                    msg = f"{self._path}: {wrong}"
                    raise FrameSourceError(msg)
                position_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
                if count:
                    time_s = self._time_after(time_s, position_s - first_s)
                else:
                    first_s = position_s
                yield time_s, image
                count += 1
        if not count:
            msg = f"{self._path}: no frame can be decoded"
            raise FrameSourceError(msg)
        self._count_missing(count, time_s)

    def _time_after(self, before_s: float, position_s: float) -> float:
        """Time of a frame; position_s: as the file has it, perhaps rounded, or the same for all."""
        regular_s = round(position_s * self.frame_rate) / self.frame_rate
        time_s = regular_s if abs(regular_s - position_s) <= TIME_STEP_S else position_s
        return time_s if time_s > before_s else before_s + 1 / self.frame_rate

    def _count_missing(self, count: int, last_s: float) -> None:
        if self._path.suffix.lower() not in COUNTING_SUFFIXES:
            # Where the frame rate varies, there are fewer in the same time.
            count = max(count, round(last_s * self.frame_rate) + 1)
        missing = self.declared_frames - count
        if missing > 0:
            text = (
                f"{self._path}: {count} of {self.declared_frames} frames can be read; the others "
                "are damaged, or were cut off without encoding the video again"
            )
            self.health = frames.SourceHealth(missing, text)

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        capture = cv2.VideoCapture(str(self._path))
        try:
            if not capture.isOpened():
                msg = f"{self._path}: found {self._path.stat().st_size} bytes, expected a video"
                raise FrameSourceError(msg)
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            yield capture
        finally:
            capture.release()
