"""Threads: views are worked on at once, nothing goes on behind the caller, BLAS has one of them."""

from __future__ import annotations

import gc
import multiprocessing
import threading
import time
from contextlib import ExitStack

import cv2
import pytest
from command_output import output_of
from threadpoolctl import threadpool_info, threadpool_limits
from waiting import wait_until

from cmp_tactile_processing.cache.threads import ViewThreads, one_thread

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


def allowed() -> set[int]:
    """Numbers of threads that the BLAS libraries may take."""
    return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}


def test_limits_that_overlap_end_with_the_last_one() -> None:
    """As of a thread that builds a model while another one processes frames."""
    with threadpool_limits(limits=2, user_api="blas"):
        if allowed() != {2}:
            pytest.skip("BLAS was built without threads")
        build, frame = ExitStack(), ExitStack()
        build.enter_context(one_thread())
        frame.enter_context(one_thread())
        build.close()
        assert allowed() == {1}
        frame.close()
        assert allowed() == {2}


def test_opencv_has_its_threads_back_afterwards() -> None:
    """Somebody's own pictures in the same process are filtered as before."""
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        if cv2.getNumThreads() != 2:
            pytest.skip("OpenCV was built without threads")
        with one_thread():
            with one_thread():
                assert cv2.getNumThreads() == 1
            assert cv2.getNumThreads() == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)


LATE = """
import numpy
from cmp_tactile_processing.cache.threads import one_thread
with one_thread():
    pass
import scipy.linalg
from threadpoolctl import threadpool_info
with one_thread():
    print({item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"})
"""


def test_the_limit_holds_for_the_blas_of_scipy_too() -> None:
    """SciPy has one of its own, which was not found where it was loaded after the first limit."""
    assert output_of("-c", LATE, OPENBLAS_NUM_THREADS="2") == "{1}\n"
