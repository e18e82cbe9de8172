"""Rigs as they are built: like their description up to an unknown change of known size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.errors import DescriptionError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror, ViewDescription
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream

# Directions of the changes are drawn so often until the pattern lies in all views.
MOST_DRAWS = 200
# The pattern keeps this distance from the sides of its view, in checkers.
MARGIN_CHECKERS = 1.5


def changed_rig(  # noqa: PLR0913, PLR0917 - one keyword for each thing that is changed
    sensor: SensorDescription,
    seed: int,
    turn: float = math.radians(1.0),
    shift: float = 0.5e-3,
    focal: float = 0.01,
    principal_point: float = 0.0,
) -> SensorDescription:
    """The sensor with gel, mirrors and camera changed by exactly that much in random directions.

    turn: rad, of the gel about any axis and of each mirror's plane about the foot point of the
    camera on it.  shift: m, of the gel along any direction and of each mirror along its normal.
    focal: relative, of fx and fy alike.  principal_point: px, in any direction.  Of a two_view
    sensor, each view's pose and camera.  The whole pattern at rest stays in all views.
    Raises SimulationError where no direction leaves it there.
    """
    rng = random_stream(Purpose.CHANGED_RIG, seed)
    sizes = {"turn": turn, "shift": shift, "focal": focal, "principal_point": principal_point}
    for _ in range(MOST_DRAWS):
        changed = _drawn(sensor, sizes, rng)
        if _shows_all(changed):
            return changed
    msg = (
        f"{sensor.name}: found no change by {math.degrees(turn):g} degrees, {shift * 1e3:g} mm and "
        f"{focal:.3g} in focal length that leaves the pattern in all views"
    )
    raise SimulationError(msg)


def _drawn(
    sensor: SensorDescription, sizes: Mapping[str, float], rng: np.random.Generator
) -> SensorDescription:
    optics, camera = sensor.optics, sensor.camera
    if optics.T_camera_gel is not None:
        optics = replace(optics, T_camera_gel=_moved(optics.T_camera_gel, sizes, rng))
    if camera is not None and optics.type != "two_view":
        camera = _changed_camera(camera, sizes, rng)
    views = {name: _changed_view(view, sizes, rng) for name, view in sensor.views.items()}
    return replace(sensor, optics=optics, camera=camera, views=views, calibration=None)


def _changed_view(
    view: ViewDescription, sizes: Mapping[str, float], rng: np.random.Generator
) -> ViewDescription:
    if view.mirror is not None:
        view = replace(view, mirror=_changed_mirror(view.mirror, sizes, rng))
    if view.T_view_gel is not None:
        view = replace(view, T_view_gel=_moved(view.T_view_gel, sizes, rng))
    if view.camera is not None:
        view = replace(view, camera=_changed_camera(view.camera, sizes, rng))
    return view


def _changed_camera(camera: Camera, sizes: Mapping[str, float], rng: np.random.Generator) -> Camera:
    scale = 1 + sizes["focal"] * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0, 2 * math.pi)
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=camera.cx + sizes["principal_point"] * math.cos(angle),
        cy=camera.cy + sizes["principal_point"] * math.sin(angle),
    )


def _changed_mirror(mirror: Mirror, sizes: Mapping[str, float], rng: np.random.Generator) -> Mirror:
    axis = np.cross(mirror.normal, _unit(rng))
    axis /= np.linalg.norm(axis)
    normal = Rotation.from_rotvec(sizes["turn"] * axis).apply(mirror.normal)
    normal /= np.linalg.norm(normal)
    return Mirror(normal, mirror.distance + sizes["shift"] * float(rng.choice([-1.0, 1.0])))


def _moved(
    T: NDArray[np.float64], sizes: Mapping[str, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """T (4, 4) after the gel turned about its apex and shifted."""
    turn, shift = sizes["turn"] * _unit(rng), sizes["shift"] * _unit(rng)
    moved = np.eye(4)
    moved[:3, :3] = (Rotation.from_matrix(T[:3, :3]) * Rotation.from_rotvec(turn)).as_matrix()
    moved[:3, 3] = T[:3, 3] + T[:3, :3] @ shift
    return moved


def _unit(rng: np.random.Generator) -> NDArray[np.float64]:
    direction = rng.standard_normal(3)
    return np.asarray(direction / np.linalg.norm(direction))


def _shows_all(sensor: SensorDescription) -> bool:
    try:
        views = build_views(sensor).values()
    except DescriptionError:
        return False
    for view in views:
        q = view.project(sensor.pattern.corners())
        side = max(float(np.abs(np.diff(q, axis=axis)).max()) for axis in (0, 1))
        limit = np.array([view.placement.width, view.placement.height]) - 1
        margin = MARGIN_CHECKERS * side
        if not ((q > margin) & (q < limit - margin)).all():
            return False
    return True
