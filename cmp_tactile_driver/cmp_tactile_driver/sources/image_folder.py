"""Frames from a folder of images."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import FrameSourceError, ImageDecodingError, WrongSizeError
from cmp_tactile_driver.sources.files import DEFAULT_FRAME_RATE, FileSource
from cmp_tactile_driver.sources.frames import MOST_WRONG_SIZES, Frame, ImageSize, SourceOptions
from cmp_tactile_driver.sources.image_decoding import decode_file

__all__ = ["IMAGE_SUFFIXES", "ImageFolder", "image_files"]

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")


def image_files(folder: Path) -> list[Path]:
    """The images of a folder in natural order: 2.png before 10.png.

    Raises FrameSourceError where there is no such folder or no image in it.
    """
    if not folder.is_dir():
        msg = f"{folder}: found no such folder, expected one with images"
        raise FrameSourceError(msg)
    files = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES]
    if not files:
        count = sum(1 for _ in folder.iterdir())
        expected = ", ".join(IMAGE_SUFFIXES)
        msg = f"{folder}: found no image among {count} entries, expected {expected}"
        raise FrameSourceError(msg)
    return sorted(files, key=_natural_key)


class ImageFolder(FileSource):
    """A FrameSource that reads the images of a folder in natural order."""

    def __init__(
        self,
        folder: Path,
        frame_rate: float,
        *,
        loop: bool = False,
        expected_size: ImageSize | None = None,
    ) -> None:
        """expected_size: where absent, the size of the first good image.

        Raises FrameSourceError for an absent folder and one without images.
        """
        super().__init__(folder, frame_rate, loop=loop, expected_size=expected_size)
        self._files = image_files(folder)
        self._next = 0
        self._good_in_pass = 0
        self._wrong_sizes = 0

    @classmethod
    def from_options(cls, options: SourceOptions) -> ImageFolder:
        """The source `images` of the driver."""
        return cls(
            Path(options.input).expanduser(),
            options.frame_rate or DEFAULT_FRAME_RATE,
            loop=options.loop,
            expected_size=options.frame_size,
        )

    def read(self) -> Frame | None:
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
            except ImageDecodingError as error:
                self._health = self._health.with_bad_frame(str(error))
                if not self._good_in_pass and isinstance(error, WrongSizeError):
                    self._wrong_sizes += 1
                if self._wrong_sizes == MOST_WRONG_SIZES:
                    raise self._none_good(self._next) from None
                continue
            self._good_in_pass += 1
            return Frame(image, path.name)

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
        return FrameSourceError(f"{self._path}: {which}, last: {self._health.problem}")

    def _load(self, path: Path) -> NDArray[np.uint8]:
        image = decode_file(path)
        wrong = self._wrong_size((image.shape[1], image.shape[0]))
        if wrong:
            msg = f"{path}: {wrong}"
            raise WrongSizeError(msg)
        return image


def _natural_key(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts], path.name
