"""Compares a recorded camera calibration with that of a sensor description."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_driver.bags.recorded_message import RecordedCalibration
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["calibration_mismatch"]

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
        if value != expected:
            return f"{field}: found {value}, expected {expected}"
    return ""


def _lens_difference(found: RecordedCalibration, sensor: SensorDescription) -> str:
    camera = sensor.camera
    if camera is None or not found.K.any():
        return ""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    if not np.allclose(found.K, K, rtol=0, atol=MATRIX_TOLERANCE_PX):
        return f"K: found {_text(found.K)}, expected {_text(K)}"
    expected = np.array(camera.distortion)
    length = max(found.D.size, expected.size)
    # Coefficients that are left out are 0.
    D, D_expected = (np.pad(D, (0, length - D.size)) for D in (found.D, expected))
    if not np.allclose(D, D_expected, rtol=0, atol=DISTORTION_TOLERANCE):
        return f"D: found {_text(found.D)}, expected {_text(expected)}"
    return ""


def _text(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values.ravel()) + "]"
