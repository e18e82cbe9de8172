"""Pairs messages of two topics that carry the same stamp."""

from __future__ import annotations

from typing import Any

__all__ = ["StampPairing"]


class StampPairing:
    """Holds what still waits for its partner, at most `capacity` items a side.

    Partners may come late, in any order, or never: an item is given up (and counted in
    `unpaired`) only when the buffer of its side is full or the same stamp comes again.
    """

    def __init__(self, sides: tuple[str, str], capacity: int = 20) -> None:
        if capacity < 1:
            msg = f"capacity: found {capacity}, expected at least 1"
            raise ValueError(msg)
        self._capacity = capacity
        self._waiting: dict[str, dict[int, Any]] = {side: {} for side in sides}
        self._partner = dict(zip(sides, reversed(sides), strict=True))
        self._sides = sides
        self.unpaired = dict.fromkeys(sides, 0)

    def add(self, side: str, stamp_ns: int, item: Any) -> tuple[Any, Any] | None:
        """The pair that the item completes, in the order of `sides`, or None while it waits."""
        partner = self._waiting[self._partner[side]].pop(stamp_ns, None)
        if partner is not None:
            return (item, partner) if side == self._sides[0] else (partner, item)
        waiting = self._waiting[side]
        if waiting.pop(stamp_ns, None) is not None:
            self.unpaired[side] += 1
        elif len(waiting) == self._capacity:
            waiting.pop(next(iter(waiting)))
            self.unpaired[side] += 1
        waiting[stamp_ns] = item
        return None

    def forget(self, side: str) -> None:
        """Give up what waits on a side."""
        self.unpaired[side] += len(self._waiting[side])
        self._waiting[side].clear()

    def waiting(self, side: str) -> int:
        """How many items of a side wait for their partner."""
        return len(self._waiting[side])
