"""Tasks one after another in this process, several at once in processes, or on a dask cluster.

All of them give the number of each task with its result, in the order in which they end.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from pathlib import Path
from typing import Any

import joblib

from cmp_tactile_bringup.errors import ClusterError, TaskError
from cmp_tactile_bringup.offline.jobs import Outcome, Task
from cmp_tactile_bringup.offline.outputs import partial_folder
from cmp_tactile_bringup.offline.processor import run_guarded
from cmp_tactile_bringup.terminal.output import OnStage
from cmp_tactile_processing.cache.files import locked

Result = tuple[int, Outcome | TaskError]
LOCK_WAIT_S = 1.0
SECONDS_TO_CONNECT = 10
SECONDS_FOR_WORKERS = 30


def run_here(tasks: Sequence[Task], on_stage: OnStage) -> Generator[Result, None, None]:
    """Run the tasks in this process."""
    for number, task in enumerate(tasks):
        yield number, run_guarded(task, on_stage)


def run_in_processes(tasks: Sequence[Task], processes: int) -> Generator[Result, None, None]:
    """Run the tasks in so many processes, each with one thread of BLAS, numba and OpenCV.

    Where one of them dies, all end: the tasks that are not finished have failed.
    """
    # A worker would look for its modules in the current folder first; beside a recording,
    # anybody's may lie.  Python 3.10 does not know the variable.
    os.environ["PYTHONSAFEPATH"] = "1"
    left = set(range(len(tasks)))
    try:
        with joblib.parallel_config("loky", n_jobs=processes, inner_max_num_threads=1):
            results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(
                joblib.delayed(_run_numbered)(number, task) for number, task in enumerate(tasks)
            )
            for number, result in results:
                left.remove(number)
                yield number, result
    except BrokenProcessPool:
        reason = "a process ended early: was there enough memory? Try fewer --jobs"
        for number in sorted(left):
            yield number, TaskError(f"{tasks[number].job.label}: {reason}")
    finally:
        # A process that is killed leaves its own; what another run writes stays.
        for number in left:
            folder = partial_folder(tasks[number].job)
            with suppress(OSError), locked(folder.with_suffix(".lock"), LOCK_WAIT_S):
                shutil.rmtree(folder, ignore_errors=True)


def _run_numbered(number: int, task: Task) -> Result:
    import cv2

    cv2.setNumThreads(1)
    return number, run_guarded(task)


def run_on_cluster(tasks: Sequence[Task], address: str) -> Generator[Result, None, None]:
    """Run the tasks on the workers of the dask scheduler at an address.

    Its workers need this software and, under the same paths, the recordings, the sensor
    description and the folder of the results.  joblib's own backend for dask waits without end for
    a task whose worker dies, so the tasks are given to dask itself.  Those that have begun go on
    to their end after an interrupt.
    Raises ClusterError without a scheduler or worker.
    """
    with _connected(address) as client:
        from distributed import as_completed

        for task in tasks:
            Path(task.job.folder).mkdir(parents=True, exist_ok=True)
        futures = {
            client.submit(_run_on_worker, task, pure=False): number
            for number, task in enumerate(tasks)
        }
        for future in as_completed(list(futures)):
            number, error = futures[future], future.exception()
            if error is None:
                yield number, future.result()
            else:
                reason = f"on the cluster: {type(error).__name__}: {error}"
                yield number, TaskError(f"{tasks[number].job.label}: {reason}")


def _connected(address: str) -> Any:
    try:
        from distributed import Client

        client = Client(address, timeout=SECONDS_TO_CONNECT)
    except ImportError as error:
        msg = f"--scheduler: found no dask ({error}), expected the package: pip install distributed"
        raise ClusterError(msg) from None
    except (OSError, ValueError) as error:
        msg = f"{address}: found no dask scheduler, expected one such as tcp://host:8786: {error}"
        raise ClusterError(msg) from None
    try:
        client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
    except TimeoutError:
        client.close()
        msg = f"{address}: found no worker within {SECONDS_FOR_WORKERS} s, expected at least one"
        raise ClusterError(msg) from None
    return client


def _run_on_worker(task: Task) -> Outcome | TaskError:
    # It was made by who sent the task; results written elsewhere would never be found.
    if not Path(task.job.folder).is_dir():
        expected = "expected a file system that all machines share, with the same paths"
        return TaskError(f"{task.job.folder}: found no such folder on a worker, {expected}")
    return run_guarded(task)
