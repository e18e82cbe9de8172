"""Threads beside the caller's, one for each further view."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


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
