"""How the long work of a calibration tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Progress", "silent"]

# What is being done, how much of it is done, how much there is.
Progress = Callable[[str, int, int], None]


def silent(doing: str, done: int, total: int) -> None:
    """A progress report that nobody reads."""
