"""Times between attempts, which become longer."""

from __future__ import annotations

__all__ = ["BackOff"]


class BackOff:
    """delay: time before the next attempt, s; `first` to begin with, doubled up to `longest`."""

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = max(first, longest)
        self.delay = first

    def wait_longer(self) -> None:
        """An attempt was in vain."""
        self.delay = min(2 * self.delay, self._longest)

    def reset(self) -> None:
        """An attempt worked."""
        self.delay = self._first
