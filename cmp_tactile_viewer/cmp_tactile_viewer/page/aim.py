"""Turns a browser's camera so that all gels are seen whole, whatever the shape of its window."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_viewer.scene.surface_mesh import MM
from cmp_tactile_viewer.snapshot import ShownSensor

# Where the camera stands, seen from the gel; with several gels, x is the direction of their line.
DIRECTIONS = {"fit": (0.4, -0.8, 0.75), "top": (0.0, -1e-3, 1.0), "side": (0.0, -1.0, 0.06)}
PRESETS = tuple(DIRECTIONS)
UP = np.array((0.0, 0.0, 1.0))
# Share of the window's half that the gel fills, and what stands above the gel in the picture, mm.
FILLED, ABOVE_MM = 0.9, 2.0
# Windows whose ratio of width to height differs by less are of one shape.
SAME_SHAPE = 0.01

Array = NDArray[np.float64]


def framed_points(sensors: Sequence[ShownSensor]) -> Array:
    """Corners of the boxes around the gels, each with its pose, (8 n, 3) mm in the scene."""
    boxes = []
    for sensor in sensors:
        corners = MM * sensor.description.pattern.corners().reshape(-1, 3)
        low, high = corners.min(axis=0), corners.max(axis=0) + (0.0, 0.0, ABOVE_MM)
        box = np.array(list(product(*zip(low, high, strict=True))))
        w, x, y, z = sensor.orientation
        boxes.append(Rotation.from_quat((x, y, z, w)).apply(box) + MM * np.array(sensor.position))
    return np.concatenate(boxes)


def camera_position(points: Array, preset: str, fov_rad: float, aspect: float) -> Array:
    """From where all points are seen, looking at their middle; (3,) in the units of the points.

    fov_rad: of the window's height.  aspect: width by height.
    """
    middle = middle_of(points)
    x, y, z = DIRECTIONS[preset]
    line = _line(points)
    towards = np.array((x * line[0] - y * line[1], x * line[1] + y * line[0], z))
    towards /= np.linalg.norm(towards)
    right = np.cross(UP, towards)
    right /= np.linalg.norm(right)
    relative = points - middle
    half = FILLED * np.tan(fov_rad / 2)
    needed = (
        np.abs(relative @ right) / (half * aspect),
        np.abs(relative @ np.cross(towards, right)) / half,
    )
    distance = float((np.maximum(*needed) + relative @ towards).max())
    return np.asarray(middle + distance * towards)


def middle_of(points: Array) -> Array:
    """Middle of the box around the points, (3,)."""
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _line(points: Array) -> Array:
    """Horizontal direction from the first gel to the last, (2,); x where there is one gel."""
    gels = points.reshape(-1, 8, 3).mean(axis=1)
    apart = (gels[-1] - gels[0])[:2]
    length = float(np.linalg.norm(apart))
    return np.asarray(apart / length) if length > 0 else np.array((1.0, 0.0))


class Aim:
    """One browser's camera: aimed by a preset, and anew when its window gets another shape.

    A camera that the user has moved stays where it is.
    """

    def __init__(self, client: viser.ClientHandle, points: Array) -> None:
        self._camera, self._points = client.camera, points
        self.take(PRESETS[0])
        client.camera.on_update(self._on_update)

    def take(self, preset: str) -> None:
        """Turn the camera as one of PRESETS."""
        camera = self._camera
        self._preset, self._aspect = preset, camera.aspect
        self._position = camera_position(self._points, preset, camera.fov, camera.aspect)
        # A new position moves `look_at` along: set it afterwards.
        camera.position = self._position
        camera.look_at, camera.up_direction = middle_of(self._points), UP

    def _on_update(self, camera: viser.CameraHandle) -> None:
        changed = abs(camera.aspect / self._aspect - 1.0) > SAME_SHAPE
        if changed and np.allclose(camera.position, self._position, rtol=0.0, atol=0.1):
            self.take(self._preset)
