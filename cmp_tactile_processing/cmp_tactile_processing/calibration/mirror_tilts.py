"""How a mirror's plane is tilted, for those that fit it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parts import Mirror

__all__ = ["tilt_axes", "tilt_directions"]


def tilt_axes(mirror: Mirror) -> tuple[int, int]:
    """The two of the camera's axes that lie most in the mirror's plane."""
    first, second = sorted(np.argsort(np.abs(mirror.normal))[:2])
    return int(first), int(second)


def tilt_directions(mirror: Mirror) -> NDArray[np.float64]:
    """(2, 3) unit vectors within the mirror's plane, towards those axes."""
    n = mirror.normal
    directions = np.stack([np.eye(3)[axis] - n[axis] * n for axis in tilt_axes(mirror)])
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))
