"""A graph in a process of its own, started as a user would start it."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.python_command import python_command

__all__ = ["ContainerError", "ContainerProcess"]

STOP_TIMEOUT_S = 15.0
LAST_LINES = 3
POLL_S = 0.02


class ContainerError(CmpTactileError):
    """The container ended early, or did not do what was waited for."""


class ContainerProcess:
    """`standalone GRAPH NAME:=VALUE ...`; a context manager that ends it with SIGTERM.

    Its output goes to a log file.
    """

    def __init__(self, graph: str, arguments: dict[str, str], log: Path) -> None:
        given = [f"{name}:={value}" for name, value in arguments.items()]
        self._command = python_command("cmp_tactile_bringup.container.standalone", graph, *given)
        self._log = log
        self.exit_code: int | None = None

    def __enter__(self) -> ContainerProcess:
        with self._log.open("a") as log:
            # A session of its own: Ctrl-C reaches the command, which then ends the container.
            self._process = subprocess.Popen(
                self._command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.terminate()
        try:
            self.exit_code = self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.exit_code = self._process.wait()

    def wait_for(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until the condition holds.

        Raises ContainerError when the process ends before, or after `timeout_s` seconds.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            if self._process.poll() is not None:
                msg = f"the container ended with code {self._process.returncode}: {self._tail()}"
                raise ContainerError(msg)
            if time.monotonic() > deadline:
                msg = f"{what}: not within {timeout_s:g} s; see {self._log}: {self._tail()}"
                raise ContainerError(msg)
            time.sleep(POLL_S)

    def _tail(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
        errors = [line for line in lines if "error" in line.lower()]
        return " | ".join((errors or lines)[-LAST_LINES:])
