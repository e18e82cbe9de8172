"""Matrix products of a frame on one thread.

BLAS shares even small products out to all cores, and wherever one of them is busy the frame waits
for it: 12 ms at the 99th percentile instead of 0.6 on two loaded cores.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock

# NumPy and SciPy each bring a BLAS; what is loaded later is not found.
import scipy.linalg.blas  # noqa: F401
from threadpoolctl import ThreadpoolController


class _Limit:
    """The number of BLAS threads, which is one for the whole process, not for each thread in it."""

    def __init__(self) -> None:
        # Finding the libraries takes milliseconds, limiting those that were found microseconds.
        controller = ThreadpoolController().select(user_api="blas")
        self._libraries = controller.lib_controllers
        self._before = [1] * len(self._libraries)
        self._lock = Lock()
        self._inside = 0

    def enter(self) -> None:
        with self._lock:
            if not self._inside:
                self._before = [library.num_threads for library in self._libraries]
                self._allow([1] * len(self._before))
            self._inside += 1

    def leave(self) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._allow(self._before)

    def _allow(self, counts: list[int]) -> None:
        for library, count in zip(self._libraries, counts, strict=True):
            if count != library.num_threads:
                library.set_num_threads(count)


@cache
def _limit() -> _Limit:
    return _Limit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it BLAS works on the caller's thread alone.

    Threads may overlap in it: as many as before are allowed when the last one has left.
    """
    limit = _limit()
    limit.enter()
    try:
        yield
    finally:
        limit.leave()
