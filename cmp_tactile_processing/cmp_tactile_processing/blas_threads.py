"""Matrix products of a frame on one thread.

BLAS shares even small products out to all cores, and wherever one of them is busy the frame waits
for it: 12 ms at the 99th percentile instead of 0.6 on two loaded cores.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController

__all__ = ["one_blas_thread"]


@cache
def _controller() -> ThreadpoolController:
    # Finding the libraries takes milliseconds, limiting those that were found microseconds.
    return ThreadpoolController()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Within it BLAS works on the caller's thread alone."""
    limited: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limited
