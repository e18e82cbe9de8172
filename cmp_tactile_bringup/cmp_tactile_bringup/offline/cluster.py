"""Jobs on an existing cluster, through dask.distributed.

Its workers need this software and, under the same paths, the recordings, the sensor description
and the folder of the results.  joblib's own backend for dask waits without end for a task whose
worker dies, so the tasks are given to dask itself.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import ClusterError, TaskError
from cmp_tactile_bringup.offline.display import Display
from cmp_tactile_bringup.offline.identity import software_version
from cmp_tactile_bringup.offline.jobs import Outcome, Task
from cmp_tactile_bringup.offline.processor import run_guarded
from cmp_tactile_bringup.recordings.library import is_packaged

SECONDS_TO_CONNECT = 10
SECONDS_FOR_WORKERS = 30


def run_on_cluster(tasks: Sequence[Task], display: Display, address: str) -> None:
    """Run the tasks on the workers of the scheduler at an address.

    Those that have begun go on to their end after an interrupt, and are found finished next time.
    Raises ClusterError without a scheduler, and without a worker that can do them.
    """
    topic = f"cmp_tactile-{uuid.uuid4().hex}"
    with _connected(address) as client:
        _check_workers(client, address)
        from distributed import as_completed

        client.subscribe_topic(topic, lambda event: display.show(*event[1]))
        futures = {}
        for number, task in enumerate(tasks):
            Path(task.job.folder).mkdir(parents=True, exist_ok=True)
            futures[client.submit(_run_on_worker, number, task, topic, pure=False)] = number
        for future in as_completed(list(futures)):
            number, error = futures[future], future.exception()
            if error is not None:
                reason = f"on the cluster: {type(error).__name__}: {error}"
                display.end(number, TaskError(f"{tasks[number].job.label}: {reason}"))
            else:
                display.end(number, future.result())


def _connected(address: str) -> Any:
    try:
        from distributed import Client

        return Client(address, timeout=SECONDS_TO_CONNECT)
    except ImportError as error:
        msg = f"--scheduler: found no dask ({error}), expected the package: pip install distributed"
    except (OSError, ValueError) as error:
        msg = f"{address}: found no dask scheduler, expected one such as tcp://host:8786: {error}"
    raise ClusterError(msg)


def _check_workers(client: Any, address: str) -> None:
    def version() -> str:
        # Sent as source, as all functions within functions are: the package may be absent there.
        from cmp_tactile_bringup.offline.identity import software_version

        return software_version()

    try:
        client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
    except TimeoutError:
        msg = f"{address}: found no worker within {SECONDS_FOR_WORKERS} s, expected at least one"
        raise ClusterError(msg) from None
    for worker, found in client.run(version, on_error="return").items():
        if isinstance(found, Exception):
            expected = "expected the same cmp_tactile_bringup as on this machine"
            msg = f"worker {worker}: found no cmp_tactile_bringup ({found}), {expected}"
            raise ClusterError(msg)
        theirs, ours = set(found.split(", ")), set(software_version().split(", "))
        if theirs != ours:
            other, wanted = (", ".join(sorted(part)) for part in (theirs - ours, ours - theirs))
            msg = f"worker {worker}: found {other}, expected {wanted}, as on this machine"
            raise ClusterError(msg)


def _run_on_worker(number: int, task: Task, topic: str) -> Outcome | TaskError:
    from distributed import get_worker

    worker = get_worker()
    error = unseen_file(task, worker.address)
    if error:
        return TaskError(error)
    return run_guarded(task, lambda event, value: worker.log_event(topic, (number, event, value)))


def unseen_file(task: Task, worker: str) -> str:
    """Which file or folder of the task this machine does not have; empty where all are there."""
    for place in map(Path, (task.job.source, task.job.sensor, task.job.folder)):
        if not place.exists() and not is_packaged(place):
            return (
                f"{place}: found no such file or folder on the worker {worker}, expected a file "
                "system that all machines share, with the same paths"
            )
    return ""
