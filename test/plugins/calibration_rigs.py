"""Rigs that are not as described, and what they show of a gel at rest and of boards."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from board_photographs import photograph_board
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.practice import board_poses
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.calibration.outcome import CalibrationOutcome
from cmp_tactile_processing.errors import Severity
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, ViewDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import true_grids
from hard_frames.deformation import Deformation, deform
from hard_frames.studio import PatternCase, PatternStudio, degrade

NOISE = 4.0
# What the tracker makes of that noise.
CORNER_NOISE_PX = 0.016
Frames = list[NDArray[np.uint8]]


@cache
def _studio() -> PatternStudio:
    return PatternStudio(samples=2)


def gel_frames(
    sensor: SensorDescription, count: int = 8, deformation: Deformation = (), seed: int = 0
) -> Frames:
    """Frames of a gel, all alike but for noise."""
    quiet = CameraSettings(read_noise=0.0)
    clear = _studio().photograph(PatternCase("gel", sensor, deformation, quiet))
    noisy = CameraSettings(blur=0.0, vignette=0.0, read_noise=NOISE)
    return [degrade(clear, noisy, seed=seed + k).image for k in range(count)]


def gel_grids(
    sensor: SensorDescription, count: int = 8, deformation: Deformation = (), seed: int = 0
) -> dict[str, list[Grid]]:
    """What a tracker finds in such frames: true corners, with noise."""
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


def two_view_rig(sensor: SensorDescription) -> SensorDescription:
    """Of a mirror rig the one of two cameras that sees the same."""
    views = {}
    for name, view in build_views(sensor).items():
        K, place = view.lens.matrix, view.placement
        focal, centre = (K[0, 0], K[1, 1]), (K[0, 2] + place.x, K[1, 2] + place.y)
        distortion = tuple(float(value) for value in view.lens.distortion)
        camera = Camera(view.lens.model, *focal, *centre, distortion)
        views[name] = ViewDescription(sensor.views[name].roi, None, camera, view.T_view_gel)
    optics = replace(sensor.optics, type="two_view", T_camera_gel=None)
    return replace(sensor, camera=None, optics=optics, views=views)


def one_view_rig(sensor: SensorDescription) -> SensorDescription:
    """Of a mirror rig the monocular one that has its left view, without a mirror."""
    left = two_view_rig(sensor).views["left"]
    optics = replace(sensor.optics, type="monocular", T_camera_gel=left.T_view_gel)
    views = {"left": ViewDescription(left.roi)}
    return replace(sensor, camera=left.camera, optics=optics, views=views)


def photograph(
    sensor: SensorDescription,
    target: BoardTarget,
    count: int = 15,
    poses: Sequence[NDArray[np.float64]] | None = None,
    seed: int = 1,
) -> Frames:
    """Frames of a board: at given poses or `count` random ones."""
    if poses is None:
        poses = board_poses(sensor, target, count, seed)
    camera = CameraSettings(read_noise=NOISE)
    return [photograph_board(sensor, target, T, camera, k) for k, T in enumerate(poses)]


def cut(sensor: SensorDescription, frames: Frames, view: str) -> Frames:
    """Un-mirrored images of one view: those of the plain camera that the mirror makes."""
    placement = build_views(sensor)[view].placement
    return [split_frame(frame, placement) for frame in frames]


def length_errors(true: Mapping[str, ViewGeometry], found: Mapping[str, ViewGeometry]) -> float:
    """RMS of the relative error of lengths above 3 mm, seen by one rig and measured by another."""
    rng = np.random.default_rng(5)
    p = rng.uniform(-5e-3, 5e-3, (1000, 3)) * (1, 1, 0.3)
    rays = [found[view].rays(true[view].project(p)) for view in ("left", "right")]
    measured = _midpoints(*rays[0], *rays[1])
    other = np.roll(np.arange(len(p)), 1)
    length = np.linalg.norm(p - p[other], axis=1)
    ratio = np.linalg.norm(measured - measured[other], axis=1) / length - 1
    return float(np.sqrt((ratio[length > 3e-3] ** 2).mean()))


Array = NDArray[np.float64]


def _midpoints(o1: Array, v1: Array, o2: Array, v2: Array) -> Array:
    """Midpoints of the common normals of rays, written out apart from the package's own."""
    way, cosine = o2 - o1, (v1 * v2).sum(axis=1)
    along1, along2 = (way * v1).sum(axis=1), (way * v2).sum(axis=1)
    t1 = (along1 - cosine * along2) / (1 - cosine**2)
    t2 = (cosine * along1 - along2) / (1 - cosine**2)
    return np.asarray((o1 + t1[:, None] * v1 + o2 + t2[:, None] * v2) / 2)


def said(outcome: CalibrationOutcome, severity: Severity) -> str:
    """All findings of a severity, text and advice, as one string."""
    chosen = [item for item in outcome.findings if item.severity is severity]
    assert all(item.text and item.advice for item in chosen)
    return " ".join(f"{item.text} {item.advice}" for item in chosen)
