"""A lock that two threads get in turn."""

from __future__ import annotations

import threading
from types import TracebackType

__all__ = ["FairLock"]


class FairLock:
    """A lock for which a thread that waits comes before one that has just released it.

    Python's own may be taken again and again by one busy thread, while the other starves.
    """

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._held = threading.Lock()

    def __enter__(self) -> None:
        with self._turn:
            self._held.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._held.release()
