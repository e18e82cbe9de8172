"""A lock between processes, which ends with the process that holds it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from types import TracebackType
from typing import IO

__all__ = ["FileLock"]


class FileLock:
    """A context manager; the file is removed by the holder when it leaves."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = None

    def __enter__(self) -> FileLock:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._file is not None:
            self._path.unlink(missing_ok=True)
            self._file.close()
            self._file = None

    def acquire(self, *, wait: bool) -> bool:
        """Take the lock; False where another process holds it and `wait` is false."""
        while True:
            file = self._path.open("w")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            except BlockingIOError:
                file.close()
                return False
            if self._is_still(file):
                self._file = file
                return True
            file.close()

    def _is_still(self, file: IO[str]) -> bool:
        """Whether the path still leads to this file: its last holder may have removed it."""
        try:
            return os.path.samestat(self._path.stat(), os.fstat(file.fileno()))
        except FileNotFoundError:
            return False
