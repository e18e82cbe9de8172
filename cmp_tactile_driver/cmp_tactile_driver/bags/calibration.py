"""What recorded camera infos say, and whether it fits a sensor's description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.ros.messages.making import whole_frame_info
from cmp_tactile_processing.sensor.description import SensorDescription


@dataclass(frozen=True)
class RecordedCalibration:
    """What a sensor_msgs/CameraInfo on `topic` says.

    width, height: 0 where it leaves them unset.  K (3, 3), px: all 0 if not calibrated.
    """

    topic: str
    width: int
    height: int
    K: NDArray[np.float64]
    D: NDArray[np.float64]


# What rounding in a description file may change; another camera differs by more.
MATRIX_TOLERANCE_PX = 0.1
DISTORTION_TOLERANCE = 1e-3


def calibration_mismatch(found: RecordedCalibration | None, sensor: SensorDescription) -> str:
    """The first difference in one line: topic, field, found, expected; empty where they agree.

    Size, K and D are compared; K and D only where the camera of the recording is calibrated and
    the sensor has one camera for the whole frame.
    """
    if found is None:
        return ""
    difference = _size_difference(found, sensor) or _lens_difference(found, sensor)
    if not difference:
        return ""
    return f"{found.topic}: {difference}: is {sensor.name} the description of this sensor?"


def _size_difference(found: RecordedCalibration, sensor: SensorDescription) -> str:
    for field in ("width", "height"):
        value, expected = getattr(found, field), getattr(sensor.image, field)
        if value not in (0, expected):
            return f"{field}: found {value}, expected {expected}"
    return ""


def _lens_difference(found: RecordedCalibration, sensor: SensorDescription) -> str:
    camera = sensor.camera
    if camera is None or not found.K.any():
        return ""
    K = whole_frame_info(sensor).K
    if not np.allclose(found.K, K, rtol=0, atol=MATRIX_TOLERANCE_PX):
        return f"K: found {_numbers(found.K)}, expected {_numbers(K)}"
    expected = np.array(camera.distortion)
    length = max(found.D.size, expected.size)
    # Coefficients that are left out are 0.
    D, D_expected = (np.pad(D, (0, length - D.size)) for D in (found.D, expected))
    if not np.allclose(D, D_expected, rtol=0, atol=DISTORTION_TOLERANCE):
        return f"D: found {_numbers(found.D)}, expected {_numbers(expected)}"
    return ""


def _numbers(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.ravel()) + "]"
