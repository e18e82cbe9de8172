"""Jobs on an existing cluster, through dask.distributed.

Its workers need this software and, under the same paths, the recordings, the sensor description
and the folder of the results.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cmp_tactile_bringup.offline.cluster_task as sent_as_source
from cmp_tactile_bringup.errors import ClusterError, TaskError
from cmp_tactile_bringup.offline.display import Display
from cmp_tactile_bringup.offline.identity import software_version
from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_bringup.offline.processes import show
from cmp_tactile_bringup.offline.remote_task import result_of, task_as_json
from cmp_tactile_bringup.offline.task import Task

__all__ = ["require_distributed", "run_on_cluster"]

SECONDS_TO_CONNECT = 10
SECONDS_FOR_WORKERS = 30


def require_distributed() -> None:
    """Raise ClusterError where dask.distributed is not installed."""
    try:
        import distributed  # noqa: F401  only whether it is there
    except ImportError as error:
        msg = f"--scheduler: found no dask ({error}), expected it: `pip install distributed`"
        raise ClusterError(msg) from None


def run_on_cluster(
    tasks: Sequence[Task], display: Display, address: str, *, debug: bool
) -> list[Outcome | Exception]:
    """What came of each task, or the error that ended it, in the order of the tasks.

    Raises ClusterError where there is no scheduler or no worker that can do them.
    """
    require_distributed()
    # As dask's own code does where classes of a program's own are to be sent.
    import cloudpickle

    for task in tasks:
        Path(task.job.folder).mkdir(parents=True, exist_ok=True)
    cloudpickle.register_pickle_by_value(sent_as_source)
    try:
        with _connected(address) as client, client.as_current():
            _check_workers(client, address)
            return _gather(client, tasks, display, debug=debug)
    finally:
        cloudpickle.unregister_pickle_by_value(sent_as_source)


def _connected(address: str) -> Any:
    from distributed import Client

    try:
        return Client(address, timeout=SECONDS_TO_CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        msg = f"{address}: found no dask scheduler, expected one such as tcp://host:8786: {error}"
        raise ClusterError(msg) from None


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=SECONDS_FOR_WORKERS)
    except TimeoutError:
        msg = f"{address}: found no worker within {SECONDS_FOR_WORKERS} s, expected one or more"
        raise ClusterError(msg) from None
    for worker, found in client.run(sent_as_source.installed_version).items():
        if found.startswith("error: "):
            msg = f"worker {worker}: {found.removeprefix('error: ')}"
            raise ClusterError(msg)
        theirs, ours = set(found.split(", ")), set(software_version().split(", "))
        if theirs != ours:
            told, wanted = (", ".join(sorted(part)) for part in (theirs - ours, ours - theirs))
            msg = f"worker {worker}: found {told}, expected {wanted}, as here"
            raise ClusterError(msg)


def _gather(
    client: Any, tasks: Sequence[Task], display: Display, *, debug: bool
) -> list[Outcome | Exception]:
    from distributed import as_completed

    topic = f"cmp_tactile-{uuid.uuid4().hex}"
    client.subscribe_topic(topic, lambda event: show(display, *event[1]))
    futures = {
        client.submit(
            sent_as_source.run_on_worker, task_as_json(task), number, topic, key=f"{topic}-{number}"
        ): number
        for number, task in enumerate(tasks)
    }
    results: dict[int, Outcome | Exception] = {}
    try:
        for future in as_completed(list(futures)):
            number = futures[future]
            error = future.exception()
            if error is None:
                results[number] = result_of(future.result(), debug=debug)
            else:
                reason = f"{type(error).__name__}: {error}"
                results[number] = TaskError(f"{tasks[number].job.label}: on the cluster: {reason}")
            display.end(number, results[number])
    except BaseException:
        # Those that have begun go on to their end, and are found finished the next time.
        client.cancel(list(futures))
        raise
    return [results[number] for number in range(len(tasks))]
