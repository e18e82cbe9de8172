"""Waiting for what happens, for as long as a busy machine may take."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

TIMEOUT_S = 120.0


def _pause() -> None:
    time.sleep(0.01)


def wait_until(
    condition: Callable[[], Any],
    what: str,
    timeout_s: float = TIMEOUT_S,
    step: Callable[[], object] = _pause,
) -> None:
    """Take steps until the condition holds; the test fails where it never does."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            pytest.fail(f"waited {timeout_s:g} s without result for {what}")
        step()
