"""Messages of a recording."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "WHOLE",
    "RecordedCalibration",
    "RecordedCameraInfo",
    "RecordedFrame",
    "RecordedMessage",
    "TimeSpan",
]


@dataclass(frozen=True)
class RecordedFrame:
    """A camera frame.

    time_ns: when it was recorded, which gives the timing.  stamp_ns, frame_id: of its header.
    image: (H, W) grey or (H, W, 3) BGR, uint8.  has_camera_info: whether its recording has
    camera infos, too.
    """

    time_ns: int
    stamp_ns: int
    frame_id: str
    image: NDArray[np.uint8]
    has_camera_info: bool = False


@dataclass(frozen=True)
class RecordedCameraInfo:
    """A sensor_msgs/CameraInfo, as the CDR bytes that were recorded."""

    time_ns: int
    data: bytes


@dataclass(frozen=True)
class RecordedCalibration:
    """What a sensor_msgs/CameraInfo on `topic` says.  K (3, 3), px: all 0 if not calibrated."""

    topic: str
    width: int
    height: int
    K: NDArray[np.float64]
    D: NDArray[np.float64]


RecordedMessage = RecordedFrame | RecordedCameraInfo


@dataclass(frozen=True)
class TimeSpan:
    """A part of a recording, in s from its beginning: from `start` on, before `end`."""

    start: float = 0.0
    end: float = math.inf

    def in_ns(self, begin_ns: int) -> tuple[int, int | None]:
        """The same as times, the end None where there is none.  begin_ns: of the recording."""
        first = begin_ns + round(self.start * 1e9)
        return first, None if math.isinf(self.end) else begin_ns + round(self.end * 1e9)


WHOLE = TimeSpan()
