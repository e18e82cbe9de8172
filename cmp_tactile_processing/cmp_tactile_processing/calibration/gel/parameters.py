"""What a calibration by the gel's own pattern may change, as a vector of changes.

Zero is the description itself.  Turns and shifts are of the gel in its own frame (rotation vector,
m), so that a turn moves the pattern about its apex instead of far about the camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.outcome import Estimate
from cmp_tactile_processing.geometry.optics import tilt_axes, tilt_directions
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parameters import Parameters, parameter
from cmp_tactile_processing.sensor.parts import Camera, Mirror, ViewDescription

AXES = "xyz"


@dataclass(frozen=True)
class GelCalibrationParameters(Parameters, section="gel calibration"):
    """What may differ from the description by how much, and when the result is good enough.

    A deviation of 0 holds a value: it is not fitted at all.  Raises ParameterError for a value
    outside its range.
    """

    turn: float = parameter(
        0.035,
        "standard deviation of each turn of the gel, a mirror or a view's camera",
        unit="rad",
        within=(0.0, 0.5),
    )
    shift: float = parameter(
        1e-3,
        "standard deviation of each shift of the gel, a mirror or a view's camera",
        unit="m",
        within=(0.0, 0.1),
    )
    focal: float = parameter(
        0.02, "standard deviation of the focal length, relative to it", within=(0.0, 0.5)
    )
    aspect: float = parameter(
        0.0, "standard deviation of the ratio fy / fx, relative to it", within=(0.0, 0.1)
    )
    principal_point: float = parameter(
        5.0,
        "standard deviation of the principal point along x and along y",
        unit="px",
        within=(0.0, 200.0),
    )
    distortion: float = parameter(
        0.0, "standard deviation of each distortion coefficient", within=(0.0, 1.0)
    )
    layer_z: float = parameter(
        0.0, "standard deviation of a refracting layer's plane", unit="m", within=(0.0, 0.01)
    )
    layer_index: float = parameter(
        0.0, "standard deviation of a refracting layer's index", within=(0.0, 0.5)
    )
    largest_deviation: float = parameter(
        4.0,
        "standard deviations from the description beyond which it is not that of this sensor",
        within=(1.0, 100.0),
    )
    robust_scale: float = parameter(
        3.0, "standard deviations from which on a corner counts less", within=(0.5, 100.0)
    )
    fewest_frames: int = parameter(
        3, "frames below which nobody knows whether the gel was still", within=(1, 1000)
    )
    wanted_frames: int = parameter(
        8, "frames below which noise is averaged less than it could be", within=(1, 1000)
    )
    least_seen: float = parameter(
        0.5, "share of the pattern that must be seen in each view", within=(0.1, 1.0)
    )
    wanted_seen: float = parameter(
        0.95, "share of the pattern below which something hides the gel", within=(0.1, 1.0)
    )
    still_limit: float = parameter(
        0.1,
        "change of the corners between frames, as a whole, above which something moved",
        unit="px",
        within=(1e-3, 10.0),
    )
    shape_limit: float = parameter(
        30e-6,
        "distance of the marker surface from its shape at rest, averaged over 3 x 3 corners, above "
        "which the gel is touched or the pattern is another one",
        unit="m",
        within=(1e-6, 1e-2),
    )
    shape_wanted: float = parameter(
        10e-6,
        "the same distance above which the description of the pattern could be better",
        unit="m",
        within=(1e-6, 1e-2),
    )
    reprojection_limit: float = parameter(
        0.5,
        "root mean square of the reprojection residuals that a good calibration has",
        unit="px",
        within=(1e-3, 10.0),
    )
    scale_limit: float = parameter(
        0.1,
        "relative change of all distances at once above which the pattern's pitch is doubted",
        within=(1e-3, 1.0),
    )


@dataclass(frozen=True)
class RigParameter:
    """One optical value: it is before + scale * change.

    name, unit, before: of the value as people know it.  prior_std: of the change; 0 holds it.
    """

    name: str
    unit: str
    prior_std: float
    before: float = 0.0
    scale: float = 1.0

    def estimate(self, change: float, std: float, *, determined: bool) -> Estimate:
        """The value before and after such a change, for people."""
        after = self.before + self.scale * change
        return Estimate(self.name, self.unit, self.before, after, abs(self.scale) * std, determined)


class RigParameters:
    """All optical values of one description; those with a prior are free.

    A mirror_stereo or monocular sensor: pose of the gel, mirrors, the camera.  A two_view sensor:
    pose of the gel in each view, and each view's camera.
    """

    def __init__(
        self, sensor: SensorDescription, options: GelCalibrationParameters | None = None
    ) -> None:
        self._sensor = sensor
        self.options = options or GelCalibrationParameters()
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

    def sensor(self, changes: NDArray[np.float64]) -> SensorDescription:
        """The description with the free parameters changed by (n,)."""
        values = [float(value) for value in changes]
        return self.changed(dict(zip(self.names, values, strict=True)))

    def changed(self, changes: Mapping[str, float]) -> SensorDescription:
        """The description with the parameters of these names changed."""
        sensor = self._sensor
        unknown = set(changes) - {item.name for item in self.all}
        if unknown:
            msg = f"{sensor.name}: found no optical value named {', '.join(sorted(unknown))}"
            raise KeyError(msg)
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
        sensor, options = self._sensor, self.options
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
            found.append(RigParameter(f"{name}.z", "m", options.layer_z, layer.z))
            found.append(RigParameter(f"{name}.index", "", options.layer_index, layer.index))
        return found

    def _pose(self, name: str) -> list[RigParameter]:
        turns = [RigParameter(f"{name}: turn about {a}", "rad", self.options.turn) for a in AXES]
        shifts = [RigParameter(f"{name}: shift along {a}", "m", self.options.shift) for a in AXES]
        return turns + shifts

    def _mirror(self, name: str, mirror: Mirror) -> list[RigParameter]:
        tilts = [
            RigParameter(f"{name}: tilt towards {AXES[axis]}", "rad", self.options.turn)
            for axis in tilt_axes(mirror)
        ]
        return [
            *tilts,
            RigParameter(f"{name}.distance", "m", self.options.shift, mirror.distance),
        ]

    def _camera(self, name: str, camera: Camera) -> list[RigParameter]:
        options, ratio = self.options, camera.fy / camera.fx
        point = options.principal_point
        return [
            RigParameter(f"{name}.fx", "px", options.focal, camera.fx, camera.fx),
            RigParameter(f"{name}.fy / fx", "", options.aspect, ratio, ratio),
            RigParameter(f"{name}.cx", "px", point, camera.cx),
            RigParameter(f"{name}.cy", "px", point, camera.cy),
            *(
                RigParameter(f"{name}.distortion[{k}]", "", options.distortion, value)
                for k, value in enumerate(camera.distortion)
            ),
        ]


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
