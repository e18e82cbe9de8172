"""Messages of a recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["RecordedCalibration", "RecordedCameraInfo", "RecordedFrame", "RecordedMessage"]


@dataclass(frozen=True)
class RecordedFrame:
    """A camera frame.

    time_ns: when it was recorded, which gives the timing.  stamp_ns, frame_id: of its header.
    image: (H, W) grey or (H, W, 3) BGR, uint8.
    """

    time_ns: int
    stamp_ns: int
    frame_id: str
    image: NDArray[np.uint8]


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
