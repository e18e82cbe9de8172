"""The status of a node on /diagnostics: its level, a sentence, figures."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.node import Node

from cmp_tactile_processing.ros.diagnostics.frame_watch import InputWatch, SentFrames, Stamp

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
# Share of a second's frames above which losses are warned of.
DROPPED_WARN = 0.01
# A source without a frame for so long is silent; a slow one after so many times the pause before
# its last frame.
SILENT_S, TIMES_USUAL = 3.0, 2


@dataclass(frozen=True)
class Finding:
    """Something to be reported, with its level; without text nothing is."""

    level: bytes
    text: str


def summary(findings: Iterable[Finding], otherwise: str) -> tuple[bytes, str]:
    """The worst level, and the texts, worst first; `otherwise` where there are none."""
    found = [item for item in findings if item.text]
    ordered = sorted(found, key=lambda item: item.level, reverse=True)
    level = ordered[0].level if ordered else OK
    return level, "; ".join(dict.fromkeys(item.text for item in ordered)) or otherwise


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


STAMP_FAULTS = {Stamp.REPEATED: "came twice", Stamp.ZERO: "were 0"}


class StageDiagnostics:
    """Counts frames and remembers the last error; `report` closes one period.

    inputs: what is known of each input.  `failure` holds the text of a lasting failure, empty while
    the stage can work; `note` and `note_level` what the stage makes of its results; `extra` further
    figures of it by name; `unpublished` input topics that nobody publishes.
    """

    def __init__(self) -> None:
        self.inputs: list[InputWatch] = []
        self.sent = SentFrames()
        self.frames_in = 0
        self.bad_frames = 0
        self.passed_over = 0
        self.started_again = 0
        self.last_error = ""
        self.failure = ""
        self.note = ""
        self.note_level: bytes = OK
        self.unpublished: list[str] = []
        self.extra: dict[str, object] = {}
        self._before = dict.fromkeys(self._counts(), 0)
        self._last_frame_s = time.monotonic()
        self._silence_s = self._usual_silence_s = 0.0

    @property
    def lost(self) -> int:
        """Messages that were sent to this node and never got to it."""
        return sum(item.lost for item in self.inputs if not item.newest)

    @property
    def frames_out(self) -> int:
        """Results that were published."""
        return self.sent.frames

    def bad_frame(self, error: str) -> None:
        """A message could not be used."""
        self.bad_frames += 1
        self.last_error = error

    def report(self) -> tuple[dict[str, object], list[Finding]]:
        """Figures of the stage by name, and what is to be reported."""
        counts = self._counts()
        new = {key: count - self._before[key] for key, count in counts.items()}
        self._before = counts
        now_s = time.monotonic()
        self._silence_s = now_s - self._last_frame_s
        if new["frames in"]:
            self._usual_silence_s, self._silence_s = self._silence_s, 0.0
            self._last_frame_s = now_s
        values = {
            **counts,
            **self.sent.close_period(),
            "started again": self.started_again,
            "last error": self.last_error,
            **self.extra,
        }
        return values, list(self._findings(new))

    def _counts(self) -> dict[str, int]:
        newer = sum(item.lost for item in self.inputs if item.newest)
        stamps = [item.stamps for item in self.inputs]
        return {
            "frames in": self.frames_in,
            "frames out": self.frames_out,
            "bad frames": self.bad_frames,
            "lost on the way": self.lost,
            "passed over": self.passed_over + newer,
            "missing frames": sum(item.missing for item in stamps),
            **{
                f"stamps {kind.value}": sum(item.stamps[kind] for item in stamps)
                for kind in (Stamp.BACK, *STAMP_FAULTS)
            },
        }

    def _findings(self, new: Mapping[str, int]) -> Iterator[Finding]:
        if self.failure:
            yield Finding(ERROR, self.failure)
            return
        longest_s = max(SILENT_S, TIMES_USUAL * self._usual_silence_s)
        if self._silence_s >= longest_s or not self.frames_in:
            why = f": no publisher of {', '.join(self.unpublished)}" if self.unpublished else ""
            yield Finding(WARN, f"no frames received{why}")
            return
        if new["bad frames"]:
            yield Finding(WARN, f"{new['bad frames']} bad frames, last: {self.last_error}")
        yield Finding(self.note_level, self.note)
        for kind, fault in STAMP_FAULTS.items():
            if count := new[f"stamps {kind.value}"]:
                yield Finding(WARN, f"stamps {fault} ({count} in the last second)")
        lost, passed_over = new["lost on the way"], new["passed over"]
        if lost + passed_over > DROPPED_WARN * (new["frames in"] + lost):
            received = new["frames in"]
            text = f"{lost} frames lost on the way, {passed_over} passed over, {received} received"
            yield Finding(WARN, text)
