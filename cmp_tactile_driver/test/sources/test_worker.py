"""A worker stops when told to, starts again, and keeps the reason of its failure."""

from __future__ import annotations

import threading

import pytest

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.capture import Worker


def test_stop_ends_a_wait_and_the_work_can_begin_again():
    begun = threading.Semaphore(0)
    stopped = []

    def work():
        begun.release()
        stopped.append(worker.wait(60.0))

    worker = Worker("test", work)
    for count in (1, 2):
        worker.start()
        assert begun.acquire(timeout=20)
        worker.stop()
        worker.stop()
        assert stopped == [True] * count
    assert worker.failure == ""


def test_a_worker_can_stop_itself():
    ended = threading.Event()

    def work():
        worker.stop()
        ended.set()

    worker = Worker("test", work)
    worker.start()
    assert ended.wait(20)


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        (FrameSourceError("no frames"), "no frames"),
        (ValueError("a bug"), "ValueError: a bug"),
    ],
)
def test_a_failure_is_kept(error, failure):
    def work():
        raise error

    worker = Worker("test", work)
    worker.start()
    worker.stop()
    assert worker.failure == failure
