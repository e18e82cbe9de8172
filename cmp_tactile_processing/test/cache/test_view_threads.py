"""Views are worked on at once, and nothing goes on behind the caller's back."""

from __future__ import annotations

import gc
import multiprocessing
import threading
import time

import pytest
from waiting import wait_until

from cmp_tactile_processing.cache.threads import ViewThreads

# Long enough for a thread of a busy machine to be scheduled.
PATIENCE_S = 20.0


def _square(number):
    return number**2


def _kept_threads():
    return {thread for thread in threading.enumerate() if thread.name.startswith("view_")}


def test_two_calls_run_at_once_on_threads_that_are_kept():
    """Each waits for the other: one after the other they would never end."""
    threads, seen = ViewThreads(2), set()
    for _ in range(3):
        meeting = threading.Barrier(2)

        def meet(number, meeting=meeting):
            meeting.wait(PATIENCE_S)
            seen.add(threading.current_thread())
            return number

        assert threads.map(meet, [0, 1]) == [0, 1]
    assert threading.current_thread() in seen
    assert len(seen) == 2


@pytest.mark.parametrize("failing", [(0,), (1,), (0, 1)])
def test_the_first_exception_in_order_comes_after_all_calls_have_ended(failing):
    threads, ended = ViewThreads(2), []

    def work(number):
        if number in failing:
            msg = f"view {number}"
            raise ValueError(msg)
        time.sleep(0.05)
        ended.append(number)

    with pytest.raises(ValueError, match=f"view {failing[0]}"):
        threads.map(work, [0, 1])
    assert set(ended) == {0, 1} - set(failing)
    assert threads.map(_square, [1, 2]) == [1, 4], "the next frame is processed"


def test_threads_end_when_dropped():
    before = _kept_threads()
    threads = ViewThreads(2)
    threads.map(_square, [1, 2])
    assert len(_kept_threads() - before) == 1
    del threads
    gc.collect()
    wait_until(lambda: not _kept_threads() - before, "the end of the thread")


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
def test_a_forked_process_has_threads_of_its_own():
    threads = ViewThreads(2)
    threads.map(_square, [1, 2])
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    child = context.Process(target=lambda: answers.put(threads.map(_square, [3, 4])))
    child.start()
    child.join(PATIENCE_S)
    alive = child.is_alive()
    child.kill()
    assert not alive, "waited for a thread that stayed in the parent"
    assert answers.get(timeout=PATIENCE_S) == [9, 16]
