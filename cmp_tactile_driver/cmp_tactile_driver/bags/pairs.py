"""Recordings of two cameras of one sensor: frames that were taken together become one."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cmp_tactile_driver.bags.reader import RecordedFrame
from cmp_tactile_driver.bags.timeline import WHOLE, TimeSpan
from cmp_tactile_driver.sources.frames import VIEWS, SourceHealth, join_views
from cmp_tactile_processing.errors import FrameSourceError
from cmp_tactile_processing.sensor.description import SensorDescription

if TYPE_CHECKING:
    from cmp_tactile_driver.bags.recording import Recording

# Pictures farther apart are reported: at 10 mm/s the gel moves by 0.05 mm between them.
MOST_APART_S = 5e-3


class PairedRecording:
    """Frames of two cameras, each of which gives the roi of one view.

    The frames nearest in time are a pair, if less than half the usual interval lies between them;
    others are counted as bad.  The time of a pair is that of its left frame.
    """

    of_surfaces = False

    def __init__(
        self,
        name: str,
        sensor: SensorDescription,
        recordings: Mapping[str, Recording],
        left_out: Sequence[Path] = (),
    ) -> None:
        """recordings: by view.  left_out: images without a partner.

        Raises FrameSourceError where a view has no frame.
        """
        self.name, self._sensor, self._left_out = name, sensor, left_out
        self._left, self._right = (recordings[view] for view in VIEWS)
        self.frame_rate: float = self._left.frame_rate
        self.codec: str = self._left.codec or self._right.codec
        # From the first left to the first right frame.
        first, other = (next(item.frames()).time_ns for item in (self._left, self._right))
        self._offset_s = (other - first) / 1e9
        self._alone, self._apart_s = 0, 0.0

    @property
    def duration(self) -> float:
        """Time of the last left frame, s."""
        return self._left.duration

    @property
    def health(self) -> SourceHealth:
        """What either could not give in the last reading, and frames without a partner."""
        alone = self._alone + len(self._left_out)
        such = f", such as {self._left_out[0].name}" if self._left_out else ""
        text = f"{self.name}: {alone} frames have no partner of the other view{such}"
        return self._left.health + self._right.health + SourceHealth(alone, text if alone else "")

    @property
    def gaps(self) -> str:
        """Times that are skipped, and how far the pictures of a pair are apart in time."""
        apart = ""
        if self._apart_s > MOST_APART_S:
            apart = f"left and right pictures are up to {self._apart_s * 1e3:.1f} ms apart"
        return "; ".join(filter(None, (self._left.gaps or self._right.gaps, apart)))

    def calibration_mismatch(self, _sensor: SensorDescription) -> str:
        """Nothing: a camera info of one view is not compared."""
        return ""

    def messages(self, span: TimeSpan = WHOLE) -> Iterator[RecordedFrame]:
        """The pairs; FrameSourceError where a view has no good frame, or one is in colours."""
        self._alone, self._apart_s = 0, 0.0
        most_s = 0.5 / self.frame_rate
        begin, end = (time_s - self._offset_s for time_s in (span.start, span.end))
        rights = self._right.frames(TimeSpan(begin - most_s, end + most_s))
        right = next(rights, None)
        for left in self._left.frames(span):
            # Before the part that is asked for, a right frame needs no partner.
            while right and right.time_s + self._offset_s < left.time_s - most_s:
                self._alone += right.time_s >= begin
                right = next(rights, None)
            if right is None or right.time_s + self._offset_s > left.time_s + most_s:
                self._alone += 1
                continue
            self._apart_s = max(self._apart_s, abs(right.time_s + self._offset_s - left.time_s))
            image = join_views(self._sensor, (left.image, right.image), self.name)
            yield RecordedFrame(left.time_s, left.time_ns, left.stamp_ns, left.frame_id, image)
            right = next(rights, None)
        self._alone += sum(item.time_s < end for item in ((right, *rights) if right else ()))

    frames = messages


def pairs_by_number(
    left: Sequence[Path], right: Sequence[Path]
) -> tuple[list[tuple[Path, Path]], list[Path]]:
    """Images that were taken together, by the numbers in their names, and those without a partner.

    A number that is the same in all names of a side, such as that of its camera, does not count.
    Raises FrameSourceError for a name without a number, numbers that come twice, and no pair at
    all.
    """
    numbered = {"left": _by_number(left), "right": _by_number(right)}
    both = [number for number in numbered["left"] if number in numbered["right"]]
    if not both:
        msg = (
            f"{left[0].name} to {left[-1].name}, {right[0].name} to {right[-1].name}: found no "
            "number that is in the names of both, expected the same number in the two names of a "
            "pair"
        )
        raise FrameSourceError(msg)
    pairs = [(numbered["left"][number], numbered["right"][number]) for number in both]
    alone = [file for side in numbered.values() for n, file in side.items() if n not in both]
    return pairs, alone


def _by_number(files: Sequence[Path]) -> dict[tuple[int, ...], Path]:
    """The files of one side by the numbers that differ between their names, in their order."""
    numbers = [tuple(map(int, re.findall(r"\d+", file.stem))) for file in files]
    for file, found in zip(files, numbers, strict=True):
        if not found:
            msg = (
                f"{file}: found no number in its name, expected the number of its pair, as in "
                "left04.png"
            )
            raise FrameSourceError(msg)
    if len(set(map(len, numbers))) == 1 and len(set(numbers)) > 1:
        varying = [k for k, values in enumerate(zip(*numbers, strict=True)) if len(set(values)) > 1]
        keys = [tuple(found[k] for k in varying) for found in numbers]
    else:
        keys = [found[-1:] for found in numbers]
    chosen: dict[tuple[int, ...], Path] = {}
    for key, file in zip(keys, files, strict=True):
        if key in chosen:
            msg = f"{file}: found the same number as in {chosen[key]}, expected a different one"
            raise FrameSourceError(msg)
        chosen[key] = file
    return chosen
