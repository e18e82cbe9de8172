"""Frames with true markers in 3-D, and what our chain and OpenCV make of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.measured.markers_3d import Markers3D
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.sensor.parts import Optics, RefractingLayer
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.stereo.triangulation import common_normal
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.hard_frames.case import (
    PatternCase,
    PatternFrame,
    PatternStudio,
    degrade,
)
from cmp_tactile_simulation.hard_frames.deformation import deform, deformation_of
from cmp_tactile_simulation.hard_frames.library import load_sample
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.surface import DeformedSurface

Points = NDArray[np.float64]

# A wide lens's barrel, a little decentred.
DISTORTION = (-0.12, 0.03, 6e-4, -4e-4, 0.0)
PLATE_M, PLATE_INDEX, GEL_INDEX = 3e-3, 1.49, 1.41
CLEAN = CameraSettings(vignette=0.0)
# What is added to frames that a camera has taken already.
UNCHANGED = CameraSettings(vignette=0.0, blur=0.0, read_noise=0.0)


@dataclass(frozen=True)
class TrueMarkers:
    """Corners (rows, cols, 3), points on row and column lines (..., n, 3), gel frame, m."""

    corners: Points
    rows: Points
    cols: Points


@dataclass(frozen=True)
class Shot:
    """A frame and the markers that it shows."""

    frame: PatternFrame
    truth: TrueMarkers

    def seen_by(self, camera: CameraSettings, seed: int) -> Shot:
        """The same through a further camera, with noise of its own."""
        return replace(self, frame=degrade(self.frame, camera, seed=seed))


def with_optics(name: str, *, distorted: bool = True, layers: bool = True) -> SensorDescription:
    """A packaged rig with a distorting lens, and with a plate and the gel before the pattern."""
    sensor = load_sensor(name)
    camera, optics = sensor.camera, sensor.optics
    if distorted and camera is not None:
        camera = replace(camera, distortion=DISTORTION)
    if layers:
        base = -sensor.elastomer.size[2]
        flat = (
            RefractingLayer(base - PLATE_M, PLATE_INDEX),
            RefractingLayer(base, GEL_INDEX),
        )
        optics = replace(optics, layers=flat)
    return replace(sensor, name=f"{name}, plate and gel", camera=camera, optics=optics)


def without_layers(sensor: SensorDescription) -> SensorDescription:
    """What is believed of that rig where nobody thinks of refraction."""
    optics: Optics = replace(sensor.optics, layers=())
    return replace(sensor, optics=optics)


def without_distortion(sensor: SensorDescription) -> SensorDescription:
    """What is believed of that rig where the lens is taken for ideal."""
    if sensor.camera is None:
        return sensor
    straight = tuple(0.0 for _ in sensor.camera.distortion)
    return replace(sensor, camera=replace(sensor.camera, distortion=straight))


@cache
def _studio() -> PatternStudio:
    return PatternStudio()


def simulated(
    sensor: SensorDescription, kind: str, camera: CameraSettings = CLEAN, number: int = 0
) -> Shot:
    """A frame of the sensor with a deformation of that kind."""
    zones = deformation_of(kind, sensor.pattern)
    case = PatternCase(kind, sensor, zones, camera, frame=number)
    return Shot(_studio().photograph(case), _true_markers(deform(sensor, zones)))


def sample(sensor: SensorDescription, folder: Path, name: str) -> Shot:
    """A sample frame.  Its virtual markers are where the exact pixels of both views meet."""
    frame = load_sample(sensor, folder, name)
    views = build_views(sensor)
    found = []
    for key in ("row_lines", "col_lines"):
        rays = [view.rays(getattr(frame.truth[name], key)) for name, view in views.items()]
        found.append(common_normal(*rays[0], *rays[1])[0])
    with np.load(folder / f"{name}.npz", allow_pickle=False) as arrays:
        corners = np.asarray(arrays["corners_m"], dtype=np.float64)
    return Shot(frame, TrueMarkers(corners, *found))


def _true_markers(surface: DeformedSurface) -> TrueMarkers:
    shape = surface.pattern.shape
    i, j = np.arange(shape.rows), np.arange(shape.cols)
    part = np.arange(1, shape.points_per_segment + 1) / (shape.points_per_segment + 1)
    return TrueMarkers(
        surface.corners(),
        surface.at(i[:, None, None], j[:-1, None] + part),
        surface.at(i[:-1, None, None] + part, j[:, None]),
    )


class Chain:
    """Tracks the frames of a sensor and triangulates them, with what is believed of its optics."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.sensor = sensor
        anew = replace(sensor, tracking=replace(sensor.tracking, follow=False))
        self._trackers = {name: GridTracker(anew, name) for name in sensor.views}

    @cached_property
    def rig(self) -> StereoRig:
        """The sensor's own model."""
        return StereoRig(self.sensor)

    def grids(self, shot: Shot) -> Mapping[str, Grid]:
        """The gridlines of both views."""
        found = {}
        for name, tracker in self._trackers.items():
            place = shot.frame.truth[name].placement
            if place is not None:
                found[name] = tracker.track(split_frame(shot.frame.image, place))
        return found

    def believing(self, sensor: SensorDescription) -> StereoRig:
        """Triangulation with another model, for the same grids."""
        return StereoRig(sensor)

    def markers(self, shot: Shot, rig: StereoRig | None = None) -> Markers3D:
        """Markers of a frame in 3-D."""
        grids = self.grids(shot)
        return (rig or self.rig).triangulate(grids["left"], grids["right"])


def corner_errors(markers: Markers3D, truth: TrueMarkers) -> Points:
    """Distance from the truth of the corners that were measured, m."""
    seen = markers.status == Status.MEASURED
    return np.asarray(np.linalg.norm((markers.position - truth.corners)[seen], axis=-1))


def line_errors(markers: Markers3D, truth: TrueMarkers, status: Status) -> Points:
    """Distance from the truth of the virtual markers of that status, m."""
    parts = (
        (markers.row_position - truth.rows, markers.row_status),
        (markers.col_position - truth.cols, markers.col_status),
    )
    found = [np.linalg.norm(off[codes == status], axis=-1) for off, codes in parts]
    joined = np.concatenate(found)
    return np.asarray(joined[np.isfinite(joined)])


def displacement_errors(
    rest: tuple[Markers3D, TrueMarkers], now: tuple[Markers3D, TrueMarkers]
) -> Points:
    """Distance from the truth of the displacement from rest of corners measured in both, m."""
    seen = (rest[0].status == Status.MEASURED) & (now[0].status == Status.MEASURED)
    found = now[0].position - rest[0].position
    true = now[1].corners - rest[1].corners
    return np.asarray(np.linalg.norm((found - true)[seen], axis=-1))


def opencv_points(sensor: SensorDescription, q_left: Points, q_right: Points) -> Points:
    """cv2.triangulatePoints of undistorted pixels (N, 2) px: straight rays, (N, 3) m."""
    projections, normalised = [], []
    views = build_views(sensor)
    for view, q in ((views["left"], q_left), (views["right"], q_right)):
        lens = view.lens
        undistorted = cv2.undistortPoints(q[:, None], lens.matrix, lens.distortion)
        normalised.append(np.ascontiguousarray(undistorted[:, 0].T))
        projections.append(np.ascontiguousarray(view.T_view_gel[:3]))
    p = cv2.triangulatePoints(*projections, *normalised)
    return np.asarray((p[:3] / p[3]).T, dtype=np.float64)


def joined(parts: Sequence[Points]) -> Points:
    """All errors in one array."""
    return np.concatenate(parts) if parts else np.empty(0)
