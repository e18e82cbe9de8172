"""Rigs of every kind, and deformed gels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import (
    Camera,
    ImageSize,
    Mirror,
    Optics,
    Pattern,
    PatternSurface,
    RefractingLayer,
    Roi,
    ViewDescription,
)
from cmp_tactile_simulation.rendering.surface import DeformedSurface

Field = Callable[[NDArray[np.float64], NDArray[np.float64]], list[NDArray[np.float64]]]


@pytest.fixture(scope="session")
def sensor() -> SensorDescription:
    """The rig of the sample frames."""
    return load_sensor("sample_rig")


@pytest.fixture(scope="session")
def deformed() -> Callable[[SensorDescription, Field], DeformedSurface]:
    """Makes a surface whose displacement is a function of x and y, m, on points 0.4 mm apart."""

    def make(sensor: SensorDescription, field: Field) -> DeformedSurface:
        size = sensor.elastomer.size
        counts = [round(side / 4e-4) + 1 for side in size[:2]]
        grid = SurfaceGrid(counts[1], counts[0], size[:2])
        y, x = np.meshgrid(grid.y, grid.x, indexing="ij")
        displacement = np.stack(np.broadcast_arrays(*field(x, y)), axis=-1)
        return DeformedSurface(sensor.pattern, grid, displacement)

    return make


@pytest.fixture(scope="session")
def dent() -> Field:
    """A gel pressed in by 1 mm beside its centre, and dragged along."""

    def field(x: NDArray[np.float64], y: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        bump = np.exp(-((x - 1e-3) ** 2 + (y + 5e-4) ** 2) / (2 * 2e-3**2))
        return [3e-4 * bump, -2e-4 * bump, -1e-3 * bump]

    return field


def _pose(tilt: float, distance: float) -> NDArray[np.float64]:
    """T_camera_gel of a camera below the gel that looks up, tilted about x, m and rad."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("x", tilt).as_matrix()
    T[:3, 3] = 0, 0, distance
    return T


def _camera(model: str, focal: float, centre: tuple[float, float], *bent: float) -> Camera:
    return Camera(model, focal, focal * 1.01, *centre, bent)


@pytest.fixture(scope="session")
def rigs(sensor: SensorDescription) -> dict[str, SensorDescription]:
    """Small rigs of all kinds that a sensor description knows."""
    pattern = Pattern(7, 9, 1.5e-3, "dark", 2, PatternSurface("sphere_cap", 0.027))
    image = ImageSize(240, 200)
    whole = Roi(0, 0, 240, 200)
    plain = replace(sensor, pattern=pattern, image=image)
    left, right = Roi(0, 0, 120, 200), Roi(120, 0, 120, 200)

    def monocular(camera: Camera, *layers: RefractingLayer, **changes: object) -> SensorDescription:
        optics = Optics("monocular", _pose(0.2, 0.03), layers)
        views = {"left": ViewDescription(whole)}
        rig = replace(plain, camera=camera, optics=optics, views=views)
        return replace(rig, **changes)

    straight = _camera("pinhole", 260, (121, 98), 0, 0, 0, 0, 0)
    folded = replace(
        monocular(straight),
        views={"left": ViewDescription(whole, Mirror(np.array([0.0, 0.6, 0.8]), 0.012))},
        optics=Optics("monocular", _behind_mirror(), ()),
    )
    return {
        "mirror_stereo": replace(
            plain,
            camera=_camera("pinhole", 172, (119.5, 99.5), 0, 0, 0, 0, 0),
            views={
                name: replace(view, roi=roi)
                for (name, view), roi in zip(sensor.views.items(), (left, right), strict=True)
            },
        ),
        "two_view": replace(
            plain,
            camera=None,
            optics=Optics("two_view", None, ()),
            views={
                "left": ViewDescription(
                    left,
                    camera=_camera("pinhole", 150, (60, 99), 0.02, 0, 0, 0, 0),
                    T_view_gel=_pose(0.3, 0.032),
                ),
                "right": ViewDescription(
                    right,
                    camera=_camera("pinhole", 150, (180, 101), 0, 0, 0, 0, 0),
                    T_view_gel=_pose(-0.3, 0.032),
                ),
            },
        ),
        "distorted": monocular(_camera("pinhole", 260, (121, 98), -0.2, 0.05, 2e-3, -1e-3, 0.01)),
        "equidistant": monocular(_camera("equidistant", 280, (119, 101), 0.02, -0.01, 0, 0)),
        "layers": monocular(straight, RefractingLayer(-0.02, 1.49), RefractingLayer(-0.006, 1.41)),
        "cylinder": monocular(
            straight, pattern=replace(pattern, surface=PatternSurface("cylinder", 0.02, "y"))
        ),
        "light_corner": monocular(straight, pattern=replace(pattern, corner_checker="light")),
        "one_mirror": folded,
        "aslant": replace(
            monocular(straight, pattern=replace(pattern, surface=PatternSurface())),
            optics=Optics("monocular", _pose(0.8, 0.03), ()),
        ),
    }


def _behind_mirror() -> NDArray[np.float64]:
    """A camera pose that shows the gel upright in the mirror of `one_mirror`."""
    normal, distance = np.array([0.0, 0.6, 0.8]), 0.012
    reflect = np.eye(4)
    reflect[:3, :3] -= 2 * np.outer(normal, normal)
    reflect[:3, 3] = 2 * distance * normal
    return reflect @ np.diag([-1.0, 1.0, 1.0, 1.0]) @ _pose(0.2, 0.03)
