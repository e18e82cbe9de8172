"""Threads of a frame: one for each view, and no further ones of BLAS and OpenCV.

BLAS shares even small products out to all cores, and wherever one of them is busy the frame waits
for it: 12 ms at the 99th percentile instead of 0.6 on two loaded cores.  OpenCV's threads cost a
frame 2 ms of processor time, and gain nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ContextDecorator
from functools import cached_property
from threading import Lock
from typing import TypeVar

# NumPy, SciPy and OpenCV each bring a BLAS; what is loaded later is not found.
import cv2
import scipy.linalg.blas  # noqa: F401
from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")


class OneThread(ContextDecorator):
    """Within it, also as a decorator, BLAS and OpenCV work on the caller's thread alone.

    The limit holds for the whole process.  Threads may overlap in it: as many as before are allowed
    when the last one has left.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._inside = 0

    @cached_property
    def _controller(self) -> ThreadpoolController:
        # Finding the libraries takes milliseconds, limiting those that were found microseconds.
        return ThreadpoolController().select(user_api="blas")

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._limited = self._controller.limit(limits=1)
                self._of_opencv = cv2.getNumThreads()
                cv2.setNumThreads(1)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limited.restore_original_limits()
                cv2.setNumThreads(self._of_opencv)


_ONE_THREAD = OneThread()


def one_thread() -> OneThread:
    """The one such limit of this process."""
    return _ONE_THREAD


class ViewThreads:
    """Calls a function for several views at once, on the caller's thread and kept ones beside it.

    The kept threads start with the first call and end when this object is dropped.
    """

    def __init__(self, views: int) -> None:
        self._views = views
        self._start()

    def _start(self) -> None:
        # The pool's threads refer to it weakly: they end when nothing else holds it any more.
        self._beside = ThreadPoolExecutor(self._views - 1, "view") if self._views > 1 else None
        self._process = os.getpid()

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """The function's results, in order, once all calls have ended, also where one has failed.

        Raises what the first call in order raised that failed.
        """
        if self._process != os.getpid():
            self._start()  # threads do not come along into a forked process
        if self._beside is None or len(items) < 2:
            return [function(item) for item in items]
        others = [self._beside.submit(function, item) for item in items[1:]]
        try:
            first = function(items[0])
        finally:
            # A call that went on by itself would change what the caller believes to be at rest.
            wait(others)
        return [first, *(other.result() for other in others)]
