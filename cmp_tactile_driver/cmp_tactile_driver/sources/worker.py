"""A thread that can be stopped and that keeps the reason of its failure."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable

from cmp_tactile_processing.errors import CmpTactileError

__all__ = ["Worker"]


class Worker:
    """Runs `work` on a thread of its own; `work` is to return soon after `stopping` is true."""

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._name = name
        self._work = work
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._failure = ""

    @property
    def failure(self) -> str:
        """Why it failed, in one line; empty while it did not."""
        return self._failure

    @property
    def stopping(self) -> bool:
        """Whether it was told to stop."""
        return self._stopping.is_set()

    def wait(self, duration: float) -> bool:
        """Pause the work for so many seconds, less where it is told to stop; whether it was."""
        return self._stopping.wait(duration)

    def start(self) -> None:
        """Begin; may be called again after `stop`."""
        self._stopping.clear()
        self._failure = ""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def request_stop(self) -> None:
        """Tell it to stop, without waiting."""
        self._stopping.set()

    def stop(self) -> None:
        """Stop, and wait for the thread unless it is the caller; may be called more than once."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        try:
            self._work()
        except CmpTactileError as error:
            self._failure = str(error)
        except Exception as error:  # noqa: BLE001  the owner must learn of it, whatever it is
            traceback.print_exc()
            self._failure = f"{type(error).__name__}: {error}"
