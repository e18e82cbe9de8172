"""A task on a worker of a cluster."""

from __future__ import annotations

import json
from pathlib import Path

from cmp_tactile_bringup.offline.remote_task import Told, run_remotely
from cmp_tactile_bringup.recordings.library import is_packaged

__all__ = ["run_with_shared_files"]


def run_with_shared_files(text: str, address: str, tell: Told) -> str:
    """As `run_remotely`, once it is sure that the worker sees the files of the task."""
    job = json.loads(text)["job"]
    for place in (job["source"], job["sensor"], job["folder"]):
        if not Path(place).exists() and not is_packaged(Path(place)):
            msg = (
                f"{place}: found no such file or folder on the worker {address}, expected a file "
                "system that all machines share, with the same paths"
            )
            return json.dumps({"error": msg})
    return run_remotely(text, tell)
