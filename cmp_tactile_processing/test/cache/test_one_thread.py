"""The limit of BLAS and OpenCV to one thread, which threads of a process share."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack

import cv2
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from cmp_tactile_processing.cache.threads import one_thread


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
    threads = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, "-c", LATE]
    assert subprocess.check_output(command, env=threads, text=True) == "{1}\n"
