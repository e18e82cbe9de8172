"""Where cameras see the points of a board: pixels and their derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.mirror_tilts import tilt_axes, tilt_directions
from cmp_tactile_processing.geometry.lens import Lens
from cmp_tactile_processing.geometry.optics import FLIP_X, reflection
from cmp_tactile_processing.sensor.parts import Camera, Mirror

__all__ = [
    "CameraPair",
    "MirrorRig",
    "Projection",
    "RigModel",
    "camera_of",
    "camera_vector",
    "parameter_names",
]

COEFFICIENTS = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "equidistant": ("k1", "k2", "k3", "k4")}
NONE = np.zeros(3)


@dataclass(frozen=True)
class Projection:
    """q (n, 2) px; by_shared (n, 2, S) by the rig's parameters; by_point (n, 2, 3) by the point."""

    q: NDArray[np.float64]
    by_shared: NDArray[np.float64]
    by_point: NDArray[np.float64]


class RigModel(Protocol):
    """A rig with a vector of parameters (S,) that all images share."""

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is."""

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """Pixels of points (n, 3) m, reference frame, in a view; NaN behind its camera."""

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """(4, 4): reference frame -> right-handed optical frame of a view."""

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Unit viewing directions (n, 3), that optical frame, of pixels (n, 2)."""


def camera_vector(camera: Camera) -> NDArray[np.float64]:
    """fx, fy, cx, cy and the distortion."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def camera_of(model: str, values: NDArray[np.float64]) -> Camera:
    """The camera of such a vector."""
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    return Camera(model, fx, fy, cx, cy, tuple(distortion))


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the entries of camera_vector."""
    distortion = (f"distortion[{k}]" for k in range(len(COEFFICIENTS[model])))
    return ("fx", "fy", "cx", "cy", *distortion)


@dataclass(frozen=True)
class CameraPair:
    """One or two plain cameras; the reference frame is the left one's optical frame.

    Parameters: those of each camera, then rotation vector and translation, m, of T_right_left.
    """

    model: str
    views: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is."""
        names = [f"{view}.{name}" for view in self.views for name in parameter_names(self.model)]
        if len(self.views) == 2:
            names += [f"right: turn about {axis}" for axis in "xyz"]
            names += [f"right: shift along {axis}" for axis in "xyz"]
        return tuple(names)

    def camera(self, shared: NDArray[np.float64], view: str) -> Camera:
        """A view's camera."""
        return camera_of(self.model, shared[self._own(view)])

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """See RigModel; of the right view T_right_left."""
        T = np.eye(4)
        if view != self.views[0]:
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(shared[-6:-3])[0], shared[-3:]
        return T

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See RigModel."""
        return _lens(self.camera(shared, view)).directions(q)

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """See RigModel."""
        own = self._own(view)
        by_shared = np.zeros((len(p), 2, len(shared)))
        if view == self.views[0]:
            q, by_shared[..., own], by_point = _project(self.model, shared[own], p)
            return Projection(q, by_shared, by_point)
        R, slopes = cv2.Rodrigues(shared[-6:-3])
        p_right = p @ R.T + shared[-3:]
        q, by_shared[..., own], by_right = _project(self.model, shared[own], p_right)
        turned = np.einsum("kij,nj->nik", slopes.reshape(3, 3, 3), p)
        by_shared[..., -6:-3] = by_right @ turned
        by_shared[..., -3:] = by_right
        return Projection(q, by_shared, by_right @ R)

    def _own(self, view: str) -> slice:
        count, index = 4 + len(COEFFICIENTS[self.model]), self.views.index(view)
        return slice(index * count, (index + 1) * count)


@dataclass(frozen=True)
class MirrorRig:
    """One camera behind a mirror for each view; the reference frame is its optical frame.

    Pixels are of the whole frame, where mirrored points are seen as they are: no image is flipped.
    Parameters: the camera's, then for each mirror two tilts, rad, and the change of its distance.
    """

    model: str
    mirrors: Mapping[str, Mirror]

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is; as in a gel calibration."""
        names = [f"camera.{name}" for name in parameter_names(self.model)]
        for view, mirror in self.mirrors.items():
            names += [f"views.{view}.mirror: tilt towards {'xyz'[k]}" for k in tilt_axes(mirror)]
            names.append(f"views.{view}.mirror.distance")
        return tuple(names)

    def start(self, camera: Camera) -> NDArray[np.float64]:
        """The parameters of the description."""
        values = [camera_vector(camera)]
        values += [np.array([0.0, 0.0, mirror.distance]) for mirror in self.mirrors.values()]
        return np.concatenate(values)

    def scaled(self, shared: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
        """The parameters of a rig whose mirrors are that many times as far away."""
        changed = shared.copy()
        changed[self._camera_count + 2 :: 3] *= factor
        return np.asarray(changed)

    def camera(self, shared: NDArray[np.float64]) -> Camera:
        """The one camera."""
        return camera_of(self.model, shared[: self._camera_count])

    def mirror(self, shared: NDArray[np.float64], view: str) -> Mirror:
        """A view's mirror."""
        tilts = shared[self._own(view)]
        normal = self.mirrors[view].normal + self._tilts[view].T @ tilts[:2]
        return Mirror(normal / np.linalg.norm(normal), float(tilts[2]))

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """See RigModel."""
        count, own = self._camera_count, self._own(view)
        mirror, tilts = self.mirrors[view], self._tilts[view]
        raw = mirror.normal + tilts.T @ shared[own][:2]
        n = raw / np.linalg.norm(raw)
        slopes = (tilts - np.outer(tilts @ n, n)) / np.linalg.norm(raw)
        off = p @ n - shared[own][2]
        q, by_camera, by_image = _project(self.model, shared[:count], p - 2 * off[:, None] * n)
        by_mirror = np.empty((len(p), 3, 3))
        for k, slope in enumerate(slopes):
            by_mirror[..., k] = -2 * (np.outer(p @ slope, n) + off[:, None] * slope)
        by_mirror[..., 2] = 2 * n
        by_shared = np.zeros((len(p), 2, len(shared)))
        by_shared[..., :count] = by_camera
        by_shared[..., own] = by_image @ by_mirror
        return Projection(q, by_shared, by_image @ (np.eye(3) - 2 * np.outer(n, n)))

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """See RigModel."""
        return np.asarray(FLIP_X @ reflection(self.mirror(shared, view)))

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See RigModel; pixels of the whole frame."""
        del view
        directions = _lens(self.camera(shared)).directions(q)
        return np.asarray(directions * FLIP_X.diagonal()[:3])

    @cached_property
    def _tilts(self) -> dict[str, NDArray[np.float64]]:
        return {view: tilt_directions(mirror) for view, mirror in self.mirrors.items()}

    @property
    def _camera_count(self) -> int:
        return 4 + len(COEFFICIENTS[self.model])

    def _own(self, view: str) -> slice:
        first = self._camera_count + 3 * list(self.mirrors).index(view)
        return slice(first, first + 3)


def _lens(camera: Camera) -> Lens:
    """The lens of a whole image."""
    return Lens.of_view(camera, x=0, y=0, width=0, flipped=False)


def _project(
    model: str, values: NDArray[np.float64], p: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) of points (n, 3) in a camera's frame, by its vector (C,) and by the point."""
    K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    points, count = p.reshape(-1, 1, 3), len(values) - 4
    if model == "equidistant":
        q, slopes = cv2.fisheye.projectPoints(points, NONE, NONE, K, values[4:])
        slopes = slopes.reshape(len(p), 2, -1)
        by_camera, by_point = slopes[..., : 4 + count], slopes[..., 7 + count : 10 + count]
    else:
        q, slopes = cv2.projectPoints(points, NONE, NONE, K, values[4:])
        slopes = slopes.reshape(len(p), 2, -1)
        by_camera, by_point = slopes[..., 6 : 10 + count], slopes[..., 3:6]
    q = np.array(q, dtype=np.float64).reshape(-1, 2)
    q[p[:, 2] <= 0] = np.nan
    return q, np.asarray(by_camera, np.float64), np.asarray(by_point, np.float64)
