"""What is sent to the workers of a cluster, as source: they may lack this package, and then say so.

Nothing of the package may be imported here but within the functions.
"""

from __future__ import annotations

import json
from typing import Any

__all__ = ["installed_version", "run_on_worker"]

EXPECTED = "expected cmp_tactile_bringup as it is where the command was given"


def installed_version(expected: str = EXPECTED) -> str:
    """The software of a worker, or "error: " and why there is none."""
    try:
        from cmp_tactile_bringup.offline.identity import software_version
    except ImportError as error:
        return f"error: found no software ({error}), {expected}"
    return software_version()


def run_on_worker(text: str, number: int, topic: str, expected: str = EXPECTED) -> str:
    """Run a task; tells (number, what, value) to the topic as it goes on."""
    from distributed import get_worker

    worker = get_worker()
    try:
        from cmp_tactile_bringup.offline.cluster_worker import run_with_shared_files
    except ImportError as error:
        return json.dumps({"error": f"{worker.address}: found no software ({error}), {expected}"})

    def tell(what: str, value: Any) -> None:
        worker.log_event(topic, (number, what, value))

    return run_with_shared_files(text, worker.address, tell)
