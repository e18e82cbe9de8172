"""Frames from a folder of images."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.errors import FrameSourceError, ImageDecodingError
from cmp_tactile_driver.frame_source import Frame, ImageSize, SourceHealth, size_text
from cmp_tactile_driver.image_decoding import decode_file

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


class ImageFolder:
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
        self._folder = folder
        self._files = image_files(folder)
        self._frame_rate = frame_rate
        self._loop = loop
        self._expected_size = expected_size
        self._next = 0
        self._good_in_pass = 0
        self._health = SourceHealth()

    @property
    def name(self) -> str:
        """The folder."""
        return str(self._folder)

    @property
    def frame_rate(self) -> float:
        """Frames per second, as given."""
        return self._frame_rate

    @property
    def health(self) -> SourceHealth:
        """Images that could not be used."""
        return self._health

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
                continue
            self._good_in_pass += 1
            return Frame(image, path.name)

    def close(self) -> None:
        """Nothing to give back: files are open only while they are read."""

    def _start_over(self) -> bool:
        if not self._good_in_pass:
            msg = f"{self._folder}: none of {len(self._files)} images is good, last: "
            raise FrameSourceError(msg + self._health.problem)
        if self._loop:
            self._next = self._good_in_pass = 0
        return self._loop

    def _load(self, path: Path) -> NDArray[np.uint8]:
        image = decode_file(path)
        size = (image.shape[1], image.shape[0])
        if self._expected_size is None:
            self._expected_size = size
        if size != self._expected_size:
            msg = f"{path}: found {size_text(size)}, expected {size_text(self._expected_size)}"
            raise ImageDecodingError(msg)
        return image


def _natural_key(path: Path) -> tuple[list[tuple[int, int, str]], str]:
    parts = re.findall(r"\d+|\D+", path.name)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts], path.name
