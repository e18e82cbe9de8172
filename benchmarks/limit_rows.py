"""Limits beside what was measured, in parts that can be run one by one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

__all__ = ["LimitParts", "Row"]


@dataclass(frozen=True)
class Row:
    """A line of a table: what, its limit ("-" for none), what was measured, whether it is met."""

    part: str
    name: str
    limit: str
    measured: str
    met: bool | None


class LimitParts:
    """A run of several parts: the method `_NAME` yields the lines of part NAME."""

    PARTS: ClassVar[tuple[str, ...]] = ()

    def rows(self, parts: Sequence[str] = ()) -> Iterable[Row]:
        """The lines of these parts, one after the other; all where none is named."""
        for part in self.PARTS:
            if not parts or part in parts:
                yield from getattr(self, f"_{part}")()
