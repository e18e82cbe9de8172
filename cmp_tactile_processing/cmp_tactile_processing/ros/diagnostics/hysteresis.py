"""Levels of a node's figures that do not flicker, and what is told of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus

from cmp_tactile_processing.ros.diagnostics.parameters import DiagnosticsParameters

__all__ = ["FigureLevels", "Finding", "Hysteresis", "summary"]

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Finding:
    """Something to be told, with its level."""

    level: bytes
    text: str


class Hysteresis:
    """The level of one figure, renewed by every report.

    It rises once the figure was beyond its threshold in `told_after` reports in a row, and falls
    once it was not in `told_until` of them.
    """

    def __init__(self) -> None:
        self._told = Finding(OK, "")
        self._rising: list[Finding] = []
        self._falling = 0

    def renew(self, found: Finding, told_after: int, told_until: int) -> Finding:
        """What is to be told; found: what the figure alone would say."""
        worse, better = found.level > self._told.level, found.level < self._told.level
        self._rising = [*self._rising, found] if worse else []
        self._falling = self._falling + 1 if better else 0
        if len(self._rising) >= told_after:
            self._told = min(self._rising[-told_after:], key=_level)
            self._rising = []
        elif self._falling >= told_until or not (worse or better):
            self._told, self._falling = found, 0
        return self._told


class FigureLevels:
    """The levels of several figures, by name."""

    def __init__(self) -> None:
        self._levels: dict[str, Hysteresis] = {}

    def renew(self, found: Mapping[str, Finding], limits: DiagnosticsParameters) -> list[Finding]:
        """What is to be told of each."""
        return [
            self._levels.setdefault(name, Hysteresis()).renew(
                item, limits.told_after, limits.told_until
            )
            for name, item in found.items()
        ]


def summary(findings: Iterable[Finding], else_told: str) -> tuple[bytes, str]:
    """The worst level, and the texts, worst first; `else_told` where there are none."""
    told = sorted((item for item in findings if item.text), key=_level, reverse=True)
    level = told[0].level if told else OK
    return level, "; ".join(dict.fromkeys(item.text for item in told)) or else_told


def _level(finding: Finding) -> bytes:
    return finding.level
