"""What a worker process does: one task after another, until its connection ends."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from paper.experiment import Busy

__all__ = ["Answer", "work"]

SECONDS_BETWEEN_LOOKS = 0.5


@dataclass(frozen=True)
class Answer:
    """What came of a task: a value, an error with its traceback, or `busy`, to be tried again.

    wall, processor: what it took, s.
    """

    value: Any = None
    error: str = ""
    trace: str = ""
    busy: bool = False
    wall: float = 0.0
    processor: float = 0.0


def work(connection: Connection) -> None:
    """Receive (function, patient), send an Answer, and so on; ends when the other side does."""
    # Ctrl-C reaches all processes of a terminal; the one that began ends these by SIGTERM.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _leave)
    _end_with_parent()

    import cv2

    cv2.setNumThreads(1)
    try:
        while True:
            run, patient = connection.recv()
            connection.send(_answer(run, patient))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return


def _answer(run: Callable[[bool], Any], patient: bool) -> Answer:
    began, used = time.perf_counter(), time.process_time()
    try:
        value, error, trace, busy = run(patient), "", "", False
    except Busy:
        value, error, trace, busy = None, "", "", True
    except Exception as found:  # noqa: BLE001  the other tasks go on
        text = f"{type(found).__name__}: {found}"
        value, error, trace, busy = None, text, traceback.format_exc(), False
    took = time.perf_counter() - began, time.process_time() - used
    return Answer(value, error, trace, busy, *took)


def _end_with_parent() -> None:
    """A parent that was killed waits for no result."""
    parent = os.getppid()

    def wait() -> None:
        while os.getppid() == parent:
            time.sleep(SECONDS_BETWEEN_LOOKS)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _leave(*_: object) -> None:
    """Remove what is not finished, and do so undisturbed."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + signal.SIGTERM)
