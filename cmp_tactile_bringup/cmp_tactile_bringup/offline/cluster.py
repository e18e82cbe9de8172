"""Jobs on an existing cluster, through dask.distributed.

Its workers need this software and, under the same paths, the recordings, the sensor description
and the folder of the results.
"""

from __future__ import annotations

import sys
import uuid
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cmp_tactile_bringup.errors import ClusterError, TaskError
from cmp_tactile_bringup.offline.jobs import Outcome
from cmp_tactile_bringup.offline.processor import Task, result_of
from cmp_tactile_bringup.offline.result_files import software_version
from cmp_tactile_bringup.offline.workers import Display

SECONDS_TO_CONNECT = 10
SECONDS_FOR_WORKERS = 30
EXPECTED = "expected cmp_tactile_bringup as it is where the command was given"


def require_distributed() -> None:
    """Raise ClusterError where dask.distributed is not installed."""
    try:
        import distributed  # noqa: F401  only whether it is there
    except ImportError as error:
        msg = f"--scheduler: found no dask ({error}), expected it: `pip install distributed`"
        raise ClusterError(msg) from None


def run_on_cluster(tasks: Sequence[Task], display: Display, address: str, *, debug: bool) -> None:
    """Run the tasks on the workers of the scheduler at an address.

    Raises ClusterError without a scheduler, and without a worker that can do them.
    """
    require_distributed()
    # As dask's own code does where classes of a program's own are to be sent.
    import cloudpickle

    for task in tasks:
        Path(task.job.folder).mkdir(parents=True, exist_ok=True)
    # As source: workers may lack this package, and then say so.
    here = sys.modules[__name__]
    cloudpickle.register_pickle_by_value(here)
    try:
        with _connected(address) as client, client.as_current():
            _check_workers(client, address)
            _gather(client, tasks, display, debug=debug)
    finally:
        cloudpickle.unregister_pickle_by_value(here)


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
    for worker, found in client.run(_installed_version).items():
        if found.startswith("error: "):
            msg = f"worker {worker}: {found.removeprefix('error: ')}"
            raise ClusterError(msg)
        theirs, ours = set(found.split(", ")), set(software_version().split(", "))
        if theirs != ours:
            other, wanted = (", ".join(sorted(part)) for part in (theirs - ours, ours - theirs))
            msg = f"worker {worker}: found {other}, expected {wanted}, as here"
            raise ClusterError(msg)


def _gather(client: Any, tasks: Sequence[Task], display: Display, *, debug: bool) -> None:
    from distributed import as_completed

    topic = f"cmp_tactile-{uuid.uuid4().hex}"
    client.subscribe_topic(topic, lambda event: display.show(*event[1]))
    futures = {
        client.submit(_run_on_worker, asdict(task), number, topic, key=f"{topic}-{number}"): number
        for number, task in enumerate(tasks)
    }
    try:
        for future in as_completed(list(futures)):
            number = futures[future]
            error = future.exception()
            if error is None:
                result: Outcome | Exception = result_of(future.result(), debug=debug)
            else:
                reason = f"{type(error).__name__}: {error}"
                result = TaskError(f"{tasks[number].job.label}: on the cluster: {reason}")
            display.end(number, result)
    except BaseException:
        # Those that have begun go on to their end, and are found finished the next time.
        client.cancel(list(futures))
        raise


def _installed_version(expected: str = EXPECTED) -> str:
    """The software of a worker, or "error: " and why there is none.

    Sent as source: nothing of the package may be named here but within the function.
    """
    try:
        from cmp_tactile_bringup.offline.result_files import software_version
    except ImportError as error:
        return f"error: found no software ({error}), {expected}"
    return software_version()


def _run_on_worker(
    values: dict[str, Any], number: int, topic: str, expected: str = EXPECTED
) -> dict[str, Any]:
    """Run a task; reports (number, event, value) to the topic.  Sent as source, as above."""
    from distributed import get_worker

    worker = get_worker()
    try:
        from cmp_tactile_bringup.offline.processor import run_with_shared_files
    except ImportError as error:
        return {"error": f"{worker.address}: found no software ({error}), {expected}"}

    def report(event: str, value: Any) -> None:
        worker.log_event(topic, (number, event, value))

    return run_with_shared_files(values, worker.address, report)
