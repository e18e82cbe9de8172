"""What recorded camera infos say, and whether it fits a sensor's description."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.rectification import ViewCameraInfo
from cmp_tactile_processing.ros.messages.making import whole_frame_info
from cmp_tactile_processing.sensor.description import SensorDescription

# What rounding in a description file may change; another camera differs by more.
MATRIX_TOLERANCE_PX = 0.1
DISTORTION_TOLERANCE = 1e-3


def calibration_mismatch(origin: str, found: ViewCameraInfo, sensor: SensorDescription) -> str:
    """The first difference in one line: origin, field, found, expected; empty where they agree.

    Size, K and D are compared: sizes that are set, which are not 0; K and D only where the camera
    is calibrated, with K other than 0, and the sensor has one camera for the whole frame.
    """
    difference = _size_difference(found, sensor) or _lens_difference(found, sensor)
    if not difference:
        return ""
    return f"{origin}: {difference}: is {sensor.name} the description of this sensor?"


def _size_difference(found: ViewCameraInfo, sensor: SensorDescription) -> str:
    for field in ("width", "height"):
        value, expected = getattr(found, field), getattr(sensor.image, field)
        if value not in (0, expected):
            return f"{field}: found {value}, expected {expected}"
    return ""


def _lens_difference(found: ViewCameraInfo, sensor: SensorDescription) -> str:
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
