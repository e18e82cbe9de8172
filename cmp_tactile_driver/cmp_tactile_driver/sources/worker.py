"""Work on a thread of its own that can be stopped, begun again, and asked why it failed."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable

from cmp_tactile_processing.errors import CmpTactileError


class Worker:
    """Runs `work` on a thread of its own; `work` is to return soon after `stopping` is true.

    failure: why it failed, in one line; empty while it did not.
    """

    def __init__(self, name: str, work: Callable[[], None]) -> None:
        self._name = name
        self._work = work
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.failure = ""

    @property
    def stopping(self) -> bool:
        """Whether it is to stop."""
        return self._stopping.is_set()

    def wait(self, duration: float) -> bool:
        """Pause the work for so many seconds, less where it is to stop; whether it is."""
        return self._stopping.wait(duration)

    def start(self) -> None:
        """Begin; may be called again after `stop`."""
        self._stopping.clear()
        self.failure = ""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def request_stop(self) -> None:
        """Ask it to stop, without waiting."""
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
            self.failure = str(error)
        except Exception as error:  # noqa: BLE001  the owner must learn of it, whatever it is
            traceback.print_exc()
            self.failure = f"{type(error).__name__}: {error}"
