"""The optical values of a sensor as a vector of changes, which calibrations and the gauge fit.

Zero is the description itself.  Turns and shifts are of the gel in its own frame (rotation vector,
m), so that a turn moves the pattern about its apex instead of far about the camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.geometry.optics import (
    ViewGeometry,
    described_view,
    tilt_axes,
    tilt_directions,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror, ViewDescription

AXES = "xyz"


@dataclass(frozen=True)
class RigPrior:
    """How far the optical values of a sensor may be from its description: standard deviations.

    A deviation of 0 holds a value: it is not fitted at all.
    """

    # Each rotation (rad) and shift (m) of the gel, a mirror or a view's camera.
    turn: float = 0.035
    shift: float = 1e-3
    # Focal length, relative, and the ratio fy / fx.
    focal: float = 0.02
    aspect: float = 0.0
    # The principal point along x and along y, px.
    principal_point: float = 5.0
    # Each coefficient of distortion.
    distortion: float = 0.0
    # A refracting layer's plane (m) and index.
    layer_z: float = 0.0
    layer_index: float = 0.0


@dataclass(frozen=True)
class RigParameter:
    """One optical value: it is before + scale * change.

    name, unit, before: of the value as people know it.  prior_std: of the change; 0 holds it.
    vector: the same for all components of a vector.
    """

    name: str
    unit: str
    prior_std: float
    before: float = 0.0
    scale: float = 1.0
    vector: str = ""


class RigParameters:
    """All optical values of one description; those with a prior are free.

    A mirror_stereo or monocular sensor: pose of the gel, mirrors, the camera.  A two_view sensor:
    pose of the gel in each view, and each view's camera.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        prior: RigPrior | None = None,
        held: tuple[str, ...] = (),
    ) -> None:
        """held: poses that are, "gel" or "views.left: gel"."""
        self._sensor, self._held = sensor, held
        self._prior = prior or RigPrior()
        self.all: tuple[RigParameter, ...] = tuple(self._listed())
        self.free: tuple[RigParameter, ...] = tuple(p for p in self.all if p.prior_std > 0)

    @property
    def prior_std(self) -> NDArray[np.float64]:
        """Standard deviations (n,) of the changes of the free parameters."""
        return np.array([item.prior_std for item in self.free])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters, in the order of the vector."""
        return tuple(item.name for item in self.free)

    def views(self, changes: NDArray[np.float64]) -> dict[str, ViewGeometry]:
        """The views of the description changed by (n,), unchecked: see `described_view`."""
        sensor = self.sensor(changes)
        return {name: described_view(sensor, name) for name in sensor.views}

    def sensor(self, values: NDArray[np.float64]) -> SensorDescription:
        """The description with the free parameters changed by (n,)."""
        changes = dict(zip(self.names, values.tolist(), strict=True))
        sensor = self._sensor
        optics = sensor.optics
        if optics.T_camera_gel is not None:
            optics = replace(optics, T_camera_gel=_moved(optics.T_camera_gel, "gel", changes))
        layers = tuple(
            replace(
                layer,
                z=layer.z + changes.get(f"optics.layers[{k}].z", 0.0),
                index=layer.index + changes.get(f"optics.layers[{k}].index", 0.0),
            )
            for k, layer in enumerate(optics.layers)
        )
        camera = sensor.camera
        if camera is not None and optics.type != "two_view":
            camera = _changed_camera(camera, "camera", changes)
        return replace(
            sensor,
            optics=replace(optics, layers=layers),
            camera=camera,
            views={name: _changed_view(v, name, changes) for name, v in sensor.views.items()},
        )

    def _listed(self) -> list[RigParameter]:
        sensor, prior = self._sensor, self._prior
        found: list[RigParameter] = []
        if sensor.optics.T_camera_gel is not None:
            found += self._pose("gel")
        for name, view in sensor.views.items():
            if view.T_view_gel is not None:
                found += self._pose(f"views.{name}: gel")
            if view.mirror is not None:
                found += self._mirror(f"views.{name}.mirror", view.mirror)
            if view.camera is not None:
                found += self._camera(f"views.{name}.camera", view.camera)
        if sensor.camera is not None and sensor.optics.type != "two_view":
            found += self._camera("camera", sensor.camera)
        for k, layer in enumerate(sensor.optics.layers):
            name = f"optics.layers[{k}]"
            found.append(RigParameter(f"{name}.z", "m", prior.layer_z, layer.z))
            found.append(RigParameter(f"{name}.index", "", prior.layer_index, layer.index))
        return found

    def _pose(self, name: str) -> list[RigParameter]:
        held, prior = name in self._held, self._prior
        turn, shift = (0.0, 0.0) if held else (prior.turn, prior.shift)
        turns = _components(f"{name}: turn about", "rad", turn)
        return turns + _components(f"{name}: shift along", "m", shift)

    def _mirror(self, name: str, mirror: Mirror) -> list[RigParameter]:
        axes = [AXES[axis] for axis in tilt_axes(mirror)]
        tilts = _components(f"{name}: tilt towards", "rad", self._prior.turn, axes)
        return [*tilts, RigParameter(f"{name}.distance", "m", self._prior.shift, mirror.distance)]

    def _camera(self, name: str, camera: Camera) -> list[RigParameter]:
        prior, ratio = self._prior, camera.fy / camera.fx
        point = prior.principal_point
        return [
            RigParameter(f"{name}.fx", "px", prior.focal, camera.fx, camera.fx),
            RigParameter(f"{name}.fy / fx", "", prior.aspect, ratio, ratio),
            RigParameter(f"{name}.cx", "px", point, camera.cx),
            RigParameter(f"{name}.cy", "px", point, camera.cy),
            *(
                RigParameter(f"{name}.distortion[{k}]", "", prior.distortion, value)
                for k, value in enumerate(camera.distortion)
            ),
        ]


def _components(
    vector: str, unit: str, prior_std: float, axes: Iterable[str] = AXES
) -> list[RigParameter]:
    return [RigParameter(f"{vector} {axis}", unit, prior_std, vector=vector) for axis in axes]


def _moved(T: NDArray[np.float64], name: str, changes: Mapping[str, float]) -> NDArray[np.float64]:
    """T (4, 4) after the gel turned and shifted in its own frame; its rotation exactly one."""
    turn = [changes.get(f"{name}: turn about {axis}", 0.0) for axis in AXES]
    shift = [changes.get(f"{name}: shift along {axis}", 0.0) for axis in AXES]
    if not any(turn) and not any(shift):
        return T
    moved = np.eye(4)
    moved[:3, :3] = (Rotation.from_matrix(T[:3, :3]) * Rotation.from_rotvec(turn)).as_matrix()
    moved[:3, 3] = T[:3, 3] + T[:3, :3] @ shift
    return moved


def _changed_mirror(mirror: Mirror, name: str, changes: Mapping[str, float]) -> Mirror:
    normal = np.array(mirror.normal, dtype=np.float64)
    for axis, direction in zip(tilt_axes(mirror), tilt_directions(mirror), strict=True):
        tilt = changes.get(f"{name}: tilt towards {AXES[axis]}", 0.0)
        normal = normal + tilt * direction
    if not np.array_equal(normal, mirror.normal):
        normal /= np.linalg.norm(normal)
    return Mirror(normal, mirror.distance + changes.get(f"{name}.distance", 0.0))


def _changed_camera(camera: Camera, name: str, changes: Mapping[str, float]) -> Camera:
    focal = 1 + changes.get(f"{name}.fx", 0.0)
    aspect = 1 + changes.get(f"{name}.fy / fx", 0.0)
    return replace(
        camera,
        fx=camera.fx * focal,
        fy=camera.fy * focal * aspect,
        cx=camera.cx + changes.get(f"{name}.cx", 0.0),
        cy=camera.cy + changes.get(f"{name}.cy", 0.0),
        distortion=tuple(
            value + changes.get(f"{name}.distortion[{k}]", 0.0)
            for k, value in enumerate(camera.distortion)
        ),
    )


def _changed_view(
    view: ViewDescription, name: str, changes: Mapping[str, float]
) -> ViewDescription:
    key = f"views.{name}"
    return replace(
        view,
        mirror=view.mirror and _changed_mirror(view.mirror, f"{key}.mirror", changes),
        camera=view.camera and _changed_camera(view.camera, f"{key}.camera", changes),
        T_view_gel=(
            None if view.T_view_gel is None else _moved(view.T_view_gel, f"{key}: gel", changes)
        ),
    )
