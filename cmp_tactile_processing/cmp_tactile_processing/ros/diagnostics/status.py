"""Levels of a node's figures, with hysteresis, and its reports on /diagnostics."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher

from cmp_tactile_processing.ros.diagnostics.namesakes import PROCESS, this_process
from cmp_tactile_processing.ros.diagnostics.thresholds import DiagnosticsParameters

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
DIAGNOSTICS_PERIOD_S = 1.0


@dataclass(frozen=True)
class Finding:
    """Something to be reported, with its level; without text nothing is."""

    level: bytes
    text: str


def finding(level: bytes, text: str) -> Finding:
    """With the text where there is something to be reported."""
    return Finding(level, text if level > OK else "")


def above(share: float, warn: float, error: float = 1.0) -> bytes:
    """The level of a share that is to be small."""
    return ERROR if share > error else WARN if share > warn else OK


def below(figure: float, warn: float, error: float) -> bytes:
    """The level of a figure that is to be large."""
    return ERROR if figure < error else WARN if figure < warn else OK


class Hysteresis:
    """The level of one figure, renewed by every report.

    It rises once the figure was beyond its threshold in `report_after` reports in a row, and falls
    once it was not in `clear_after` of them.
    """

    def __init__(self) -> None:
        self._reported = Finding(OK, "")
        self._rising: list[Finding] = []
        self._falling = 0

    def renew(self, found: Finding, report_after: int, clear_after: int) -> Finding:
        """What is to be reported; found: what the figure alone would say."""
        worse, better = found.level > self._reported.level, found.level < self._reported.level
        self._rising = [*self._rising, found] if worse else []
        self._falling = self._falling + 1 if better else 0
        if len(self._rising) >= report_after:
            self._reported = min(self._rising[-report_after:], key=_level)
            self._rising = []
        elif self._falling >= clear_after or not (worse or better):
            self._reported, self._falling = found, 0
        return self._reported


class FigureLevels:
    """The levels of several figures, by name."""

    def __init__(self) -> None:
        self._levels: dict[str, Hysteresis] = {}

    def renew(self, found: Mapping[str, Finding], limits: DiagnosticsParameters) -> list[Finding]:
        """What is to be reported of each."""
        return [
            self._levels.setdefault(name, Hysteresis()).renew(
                item, limits.report_after, limits.clear_after
            )
            for name, item in found.items()
        ]


def summary(findings: Iterable[Finding], otherwise: str) -> tuple[bytes, str]:
    """The worst level, and the texts, worst first; `otherwise` where there are none."""
    ordered = sorted((item for item in findings if item.text), key=_level, reverse=True)
    level = ordered[0].level if ordered else OK
    return level, "; ".join(dict.fromkeys(item.text for item in ordered)) or otherwise


def _level(finding: Finding) -> bytes:
    return finding.level


def status_name(node: Node) -> str:
    """Under which a node reports: its full name without the slash that it begins with."""
    return node.get_fully_qualified_name().lstrip("/")


def status_message(
    name: str, hardware_id: str, summary: tuple[bytes, str], values: Mapping[str, object]
) -> DiagnosticStatus:
    """A status; summary: level and message."""
    return DiagnosticStatus(
        level=summary[0],
        name=name,
        message=summary[1],
        hardware_id=hardware_id,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )


class DiagnosticsReporter:
    """Publishes what `status` returns once a second, and at once by `publish`.

    also_to: publishers of DiagnosticStatus that get it too.
    """

    def __init__(
        self,
        node: Node,
        status: Callable[[], DiagnosticStatus],
        also_to: Sequence[Publisher[Any]] = (),
    ) -> None:
        self._node, self._status, self._also_to = node, status, also_to
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady: a paused simulation clock must not silence the diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(DIAGNOSTICS_PERIOD_S, self.publish, clock=steady)

    def publish(self) -> None:
        """Report now."""
        status = self._status()
        status.values.append(KeyValue(key=PROCESS, value=this_process()))
        for publisher in self._also_to:
            publisher.publish(status)
        report = DiagnosticArray(status=[status])
        report.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(report)
