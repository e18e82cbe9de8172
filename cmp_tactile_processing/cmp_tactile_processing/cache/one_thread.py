"""Matrix products and image filters of a frame on one thread.

BLAS shares even small products out to all cores, and wherever one of them is busy the frame waits
for it: 12 ms at the 99th percentile instead of 0.6 on two loaded cores.  OpenCV's threads cost a
frame 2 ms of processor time, and gain nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock

# NumPy, SciPy and OpenCV each bring a BLAS; what is loaded later is not found.
import cv2
import scipy.linalg.blas  # noqa: F401
from threadpoolctl import ThreadpoolController


class _Limit:
    """Limit on the threads of BLAS and OpenCV, which holds for the whole process."""

    def __init__(self) -> None:
        # Finding the libraries takes milliseconds, limiting those that were found microseconds.
        self._controller = ThreadpoolController().select(user_api="blas")
        self._lock = Lock()
        self._inside = 0

    def enter(self) -> None:
        with self._lock:
            if not self._inside:
                self._limited = self._controller.limit(limits=1)
                self._of_opencv = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._inside += 1

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limited.restore_original_limits()
                cv2.setNumThreads(self._of_opencv)


@cache
def _limit() -> _Limit:
    return _Limit()


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it BLAS and OpenCV work on the caller's thread alone.

    Threads may overlap in it: as many as before are allowed when the last one has left.
    """
    limit = _limit()
    limit.enter()
    try:
        yield
    finally:
        limit.leave()
