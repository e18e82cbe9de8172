"""Waiting for what happens, for as long as a busy machine may take; what happens meanwhile."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

TIMEOUT_S = 120.0


def _pause() -> None:
    time.sleep(0.01)


@contextmanager
def in_background(steps: Iterable[object], interval_s: float) -> Iterator[None]:
    """Take steps on a thread of its own, one after another, as long as the block runs."""
    ended = threading.Event()

    def take() -> None:
        for _ in steps:
            if ended.wait(interval_s):
                return

    thread = threading.Thread(target=take)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def wait_until(
    condition: Callable[[], Any],
    what: str,
    timeout_s: float = TIMEOUT_S,
    step: Callable[[], object] = _pause,
) -> None:
    """Take steps until the condition holds; the test fails where it never does."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"waited {timeout_s:g} s without result for {what}")
        step()
