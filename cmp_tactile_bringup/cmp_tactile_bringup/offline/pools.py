"""Work on many items in several processes of this machine, or on a dask cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, TypeVar

import joblib

from cmp_tactile_processing.errors import CmpTactileError

SECONDS_TO_CONNECT = 10.0
SECONDS_FOR_WORKERS = 30.0

Item = TypeVar("Item")
Made = TypeVar("Made")


def in_processes(
    items: Sequence[Item], work: Callable[[Item], Made], processes: int
) -> Generator[tuple[Item, Made | CmpTactileError], None, None]:
    """Each item with what the work made of it, as soon as that is there.

    Each process has one thread of BLAS, numba and OpenCV.  Where one of them dies, all end, and
    the items that are not finished come with an error.  Paths in items are absolute.
    """
    # A worker looks for modules in the folder that it is started in; beside a recording, anybody's
    # may lie.  (Python 3.10 knows no PYTHONSAFEPATH.)
    started_in = Path.cwd()
    os.chdir("/")
    left = list(range(len(items)))
    try:
        with joblib.parallel_config("loky", n_jobs=processes, inner_max_num_threads=1):
            results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(
                joblib.delayed(_in_process)(number, item, work) for number, item in enumerate(items)
            )
            for number, result in results:
                left.remove(number)
                yield items[number], result
    except BrokenProcessPool:
        reason = "a process ended early: was there enough memory? Try fewer --jobs"
        for number in left:
            yield items[number], CmpTactileError(f"{items[number]}: {reason}")
    finally:
        os.chdir(started_in)


def _in_process(number: int, item: Item, work: Callable[[Item], Made]) -> tuple[int, Made]:
    import cv2

    cv2.setNumThreads(1)
    return number, work(item)


def on_cluster(
    items: Sequence[Item], work: Callable[[Item], Made], client: Any
) -> Generator[tuple[Item, Made | CmpTactileError], None, None]:
    """The same on the workers of a dask cluster.  client: see connected.

    joblib's own backend for dask waits without end for an item whose worker dies, so the items
    are given to dask itself.  Those that have begun go on to their end after an interrupt.
    """
    from distributed import as_completed

    futures = {client.submit(work, item, pure=False): item for item in items}
    for future in as_completed(list(futures), loop=client.loop):
        item, error = futures[future], future.exception()
        if error is None:
            yield item, future.result()
        else:
            reason = f"on the cluster: {type(error).__name__}: {error}"
            yield item, CmpTactileError(f"{item}: {reason}")


def connected(address: str) -> Any:
    """The client of a dask scheduler that has a worker: a context; CmpTactileError without."""
    try:
        from distributed import Client

        # Not for all that dask computes in this process: a client without scheduler stays.
        client = Client(address, timeout=SECONDS_TO_CONNECT, set_as_default=False)
    except ImportError as error:
        msg = f"--scheduler: found no dask ({error}), expected the package: pip install distributed"
        raise CmpTactileError(msg) from None
    except (OSError, ValueError) as error:
        msg = f"{address}: found no dask scheduler, expected one such as tcp://host:8786: {error}"
        raise CmpTactileError(msg) from None
    try:
        client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
    except TimeoutError:
        client.close()
        msg = f"{address}: found no worker within {SECONDS_FOR_WORKERS} s, expected at least one"
        raise CmpTactileError(msg) from None
    return client
