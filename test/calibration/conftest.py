"""Frames of rigs that differ from their description, for calibrations by the gel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, ViewDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import true_grids
from hard_frames.deformation import Deformation, deform
from hard_frames.studio import PatternCase, PatternStudio, degrade, pattern_rig

NOISE = 4.0
# What the tracker makes of that noise.
CORNER_NOISE_PX = 0.016
Frames = list[NDArray[np.uint8]]


@pytest.fixture(scope="session")
def gel_rig() -> SensorDescription:
    """A mirror rig like the sample's with 12 x 12 corners: quick to fit."""
    return pattern_rig(12, 12)


@pytest.fixture(scope="session")
def gel_frames() -> Callable[..., Frames]:
    """Takes frames of a rig, all alike but for noise of 4 grey levels."""
    studio = PatternStudio(samples=2)

    def take(
        sensor: SensorDescription, count: int = 8, deformation: Deformation = (), seed: int = 0
    ) -> Frames:
        clear = studio.photograph(
            PatternCase("gel", sensor, deformation, CameraSettings(read_noise=0.0))
        )
        noisy = CameraSettings(blur=0.0, vignette=0.0, read_noise=NOISE)
        return [degrade(clear, noisy, seed=seed + k).image for k in range(count)]

    return take


@pytest.fixture(scope="session")
def gel_grids() -> Callable[..., dict[str, list[Grid]]]:
    """What a tracker finds in frames of a rig: its true corners, with noise."""

    def find(
        sensor: SensorDescription, count: int = 8, deformation: Deformation = (), seed: int = 0
    ) -> dict[str, list[Grid]]:
        rng = np.random.default_rng([11, seed])
        truth = true_grids(sensor, deform(sensor, deformation))
        return {
            name: [
                replace(
                    grid,
                    corners=grid.corners + rng.normal(0.0, CORNER_NOISE_PX, grid.corners.shape),
                    corner_std=np.full(grid.corner_status.shape, CORNER_NOISE_PX),
                )
                for _ in range(count)
            ]
            for name, grid in truth.items()
        }

    return find


@pytest.fixture(scope="session")
def two_view_rig() -> Callable[[SensorDescription], SensorDescription]:
    """Makes of a mirror rig the one of two cameras that sees the same."""

    def make(sensor: SensorDescription) -> SensorDescription:
        views = {}
        for name, view in build_views(sensor).items():
            K, place = view.lens.matrix, view.placement
            focal, centre = (K[0, 0], K[1, 1]), (K[0, 2] + place.x, K[1, 2] + place.y)
            distortion = tuple(float(value) for value in view.lens.distortion)
            camera = Camera(view.lens.model, *focal, *centre, distortion)
            views[name] = ViewDescription(sensor.views[name].roi, None, camera, view.T_view_gel)
        optics = replace(sensor.optics, type="two_view", T_camera_gel=None)
        return replace(sensor, camera=None, optics=optics, views=views)

    return make


@pytest.fixture(scope="session")
def one_view_rig(
    two_view_rig: Callable[[SensorDescription], SensorDescription],
) -> Callable[[SensorDescription], SensorDescription]:
    """Makes of a mirror rig the monocular one that has its left view, without a mirror."""

    def make(sensor: SensorDescription) -> SensorDescription:
        left = two_view_rig(sensor).views["left"]
        optics = replace(sensor.optics, type="monocular", T_camera_gel=left.T_view_gel)
        views = {"left": ViewDescription(left.roi)}
        return replace(sensor, camera=left.camera, optics=optics, views=views)

    return make


@pytest.fixture(scope="session")
def exchanged() -> Callable[[Sequence[NDArray[np.uint8]]], Frames]:
    """Exchanges the left and right halves of frames."""
    return lambda frames: [np.roll(frame, frame.shape[1] // 2, axis=1) for frame in frames]
