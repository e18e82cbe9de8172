"""What a stage did since it started and in the last second, as a DiagnosticStatus."""

from __future__ import annotations

import math
import time

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

__all__ = ["StageDiagnostics"]


class StageDiagnostics:
    """Counts frames and remembers the last error; `status` closes one period.

    `failure` holds the text of a lasting failure, empty while the stage can work; `note` and
    `note_level` what the stage makes of its results; `extra` further figures of it by name.
    """

    def __init__(self) -> None:
        self.frames_in = 0
        self.frames_out = 0
        self.bad_frames = 0
        self.last_error = ""
        self.failure = ""
        self.note = ""
        self.note_level: bytes = DiagnosticStatus.OK
        self.extra: dict[str, object] = {}
        self._latency_s = math.nan
        self._before = (0, 0, 0)
        self._since = time.monotonic()

    def frame_in(self) -> None:
        """A message came in."""
        self.frames_in += 1

    def frame_out(self, latency_s: float = math.nan) -> None:
        """A result was published, `latency_s` after the stamp of its camera frame."""
        self.frames_out += 1
        self._latency_s = latency_s

    def bad_frame(self, error: str) -> None:
        """A message could not be used."""
        self.bad_frames += 1
        self.last_error = error

    def status(self, name: str, hardware_id: str) -> DiagnosticStatus:
        """The state of the stage; rates are those since the last call."""
        now = time.monotonic()
        period = max(now - self._since, 1e-9)
        counts = (self.frames_in, self.frames_out, self.bad_frames)
        new_in, new_out, new_bad = (
            count - before for count, before in zip(counts, self._before, strict=True)
        )
        self._before, self._since = counts, now
        level, message = self._judge(new_in, new_bad)
        values: dict[str, object] = {
            "frames in": self.frames_in,
            "frames out": self.frames_out,
            "bad frames": self.bad_frames,
            "rate (Hz)": f"{new_out / period:.2f}",
            "latency (ms)": f"{self._latency_s * 1e3:.1f}",
            "last error": self.last_error,
            **self.extra,
        }
        pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        return DiagnosticStatus(
            level=level, name=name, message=message, hardware_id=hardware_id, values=pairs
        )

    def _judge(self, new_in: int, new_bad: int) -> tuple[bytes, str]:
        if self.failure:
            return DiagnosticStatus.ERROR, self.failure
        if new_bad and self.note_level < DiagnosticStatus.ERROR:
            return DiagnosticStatus.WARN, f"{new_bad} bad frames, last: {self.last_error}"
        if not new_in:
            return DiagnosticStatus.WARN, "no frames come in"
        return self.note_level, self.note or "running"
