"""What sources that read files have in common."""

from __future__ import annotations

from pathlib import Path

from cmp_tactile_driver.sources.frames import ImageSize, SourceHealth, size_text

__all__ = ["DEFAULT_FRAME_RATE", "FileSource"]

DEFAULT_FRAME_RATE = 30.0
"""Of files that do not tell theirs, Hz."""


class FileSource:
    """Name, rate, health and frame size of a FrameSource that reads a file or folder."""

    def __init__(
        self, path: Path, frame_rate: float, *, loop: bool, expected_size: ImageSize | None
    ) -> None:
        """expected_size: where absent, the size of the first frame that is compared."""
        self._path = path
        self._frame_rate = frame_rate
        self._loop = loop
        self._expected_size = expected_size
        self._health = SourceHealth()

    @property
    def name(self) -> str:
        """The file or folder."""
        return str(self._path)

    @property
    def frame_rate(self) -> float:
        """Frames per second."""
        return self._frame_rate

    @property
    def health(self) -> SourceHealth:
        """Frames that could not be used."""
        return self._health

    def _wrong_size(self, size: ImageSize) -> str:
        """What was found and expected; empty where the size is right."""
        self._expected_size = self._expected_size or size
        if size == self._expected_size:
            return ""
        return f"found {size_text(size)}, expected {size_text(self._expected_size)}"
