"""What a worker process does: one task after another, until its connection ends."""

from __future__ import annotations

import os
import signal
import sys
from multiprocessing.connection import Connection

__all__ = ["work"]


def work(connection: Connection) -> None:
    """Receive tasks, send (what, value) as they go on, and ("result", JSON) at the end of each.

    Ends when the other side does, also in the middle of a task.
    """
    # Ctrl-C reaches all processes of a terminal; the one that began ends these by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)

    import cv2

    from cmp_tactile_bringup.offline.remote_task import run_remotely

    cv2.setNumThreads(1)
    parent = os.getppid()

    def tell(what: str, value: object) -> None:
        if os.getppid() != parent:
            sys.exit(1)  # killed; nobody waits for these results
        connection.send((what, value))

    try:
        while True:
            tell("result", run_remotely(connection.recv(), tell))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _leave(*_: object) -> None:
    """Remove what is not finished, and do so undisturbed."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signal.SIGTERM)
