"""Frames with true markers in 3-D, what our chain and OpenCV make of them, and how fast."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.gel.calibrate import calibrate_gel
from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.refraction import RayModel
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Markers3D, Status
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.parts import Optics, RefractingLayer
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.stereo.triangulation import common_normal, triangulate
from cmp_tactile_processing.surface.displacement import Reference
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.hard_frames.case import (
    PatternCase,
    PatternFrame,
    PatternStudio,
    deform,
    deformation_of,
    degrade,
)
from cmp_tactile_simulation.hard_frames.changed_rig import changed_rig
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
        fresh = replace(sensor, tracking=replace(sensor.tracking, follow=False))
        self._trackers = {name: GridTracker(fresh, name) for name in sensor.views}

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


REPEATS = 1000
NOISE_PX = 0.02


@dataclass(frozen=True)
class Speed:
    """Shortest times of many runs, ms, and what else was found."""

    ours_ms: float
    refracted_ms: float
    notes: dict[str, str]


def measure_speed(chain: Chain, shot: Shot) -> Speed:
    """Times for one frame's grids: the whole stage, and points alone against OpenCV."""
    truth = shot.frame.truth
    ours = shortest_ms(lambda: chain.rig.triangulate(truth["left"], truth["right"]))
    sensor = with_optics("sample_rig")
    refracted, grids = StereoRig(sensor), simulated(sensor, "slide").frame.truth
    refracted_ms = shortest_ms(lambda: refracted.triangulate(grids["left"], grids["right"]))
    notes = _against_opencv(chain, shot) | _straight_through(sensor, grids)
    return Speed(ours, refracted_ms, notes)


def _straight_through(sensor: SensorDescription, truth: Mapping[str, Grid]) -> dict[str, str]:
    """What rays that do not bend make of exact pixels seen through plate and gel."""
    left, right = (truth[name].corners.reshape(-1, 2) for name in ("left", "right"))
    true = StereoRig(sensor).triangulate(truth["left"], truth["right"]).position
    off = _mean_um(opencv_points(sensor, left, right) - true.reshape(-1, 3))
    return {"cv2.triangulatePoints, exact pixels, plate and gel": f"error {off:.0f} um"}


def _against_opencv(chain: Chain, shot: Shot) -> dict[str, str]:
    """The same 400 + 4,560 pairs, undistorted and triangulated by both; noise of 0.02 px."""
    rng = np.random.default_rng(0)
    pixels = {
        name: np.concatenate(
            [part.reshape(-1, 2) for part in (grid.corners, grid.row_lines, grid.col_lines)]
        )
        for name, grid in shot.frame.truth.items()
    }
    noisy = {name: q + rng.normal(0, NOISE_PX, q.shape) for name, q in pixels.items()}
    parts = (shot.truth.corners, shot.truth.rows, shot.truth.cols)
    true = np.concatenate([part.reshape(-1, 3) for part in parts])
    views = build_views(chain.sensor)
    models = {
        name: RayModel(view.lens, view.T_view_gel, view.layers) for name, view in views.items()
    }
    std = np.full(len(true), NOISE_PX)

    def ours() -> Points:
        rays = models["left"].bundle(noisy["left"]), models["right"].bundle(noisy["right"])
        return triangulate(rays, (std, std), weighted=True, max_gap=1e-3).position

    def opencv() -> Points:
        return opencv_points(chain.sensor, noisy["left"], noisy["right"])

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    times = {"ours": shortest_ms(ours), "opencv": shortest_ms(opencv)}
    cv2.setNumThreads(threads)
    errors = {
        name: _mean_um(points - true) for name, points in (("ours", ours()), ("opencv", opencv()))
    }
    count = len(true)
    return {
        f"{count} pairs alone, weighted, with covariance": (
            f"{times['ours']:.3f} ms, error {errors['ours']:.2f} um"
        ),
        f"{count} pairs, cv2.undistortPoints + triangulatePoints": (
            f"{times['opencv']:.3f} ms, error {errors['opencv']:.2f} um"
        ),
        "ours / OpenCV": f"{times['ours'] / times['opencv']:.2f} of the time, "
        f"{errors['ours'] / errors['opencv']:.2f} of the error",
    }


def shortest_ms(run: Callable[[], object]) -> float:
    """The shortest of many runs: what the others took longer, other work on the machine took."""
    times = []
    for _ in range(REPEATS):
        began = perf_counter()
        run()
        times.append(perf_counter() - began)
    return 1e3 * min(times)


def _mean_um(off: Points) -> float:
    return 1e6 * float(np.nanmean(np.linalg.norm(off, axis=-1)))


REST_FRAMES = 10
NOISE_4 = replace(CLEAN, read_noise=4.0)
TOUCHES = ("press", "slide", "twist")
# Markers that moved less than this say nothing of a relative error, m.
MOVED_M = 1e-4
LARGEST_GAP_M = 1e-2


@dataclass(frozen=True)
class GelCalibration:
    """Mean error of the displacement before and after, um; after also as a share of it."""

    name: str
    before_um: float
    after_um: float
    share: float
    accepted: bool
    seconds: float


def gel_calibrations(count: int) -> Iterable[GelCalibration]:
    """So many changed rigs by 1 degree, 0.5 mm and 1 %, plain and behind a plate in turn."""
    bases = (load_sensor("sample_rig"), with_optics("prototype"))
    for seed in range(count):
        yield _calibrated(bases[seed % len(bases)], seed)


def _calibrated(described: SensorDescription, seed: int) -> GelCalibration:
    built = changed_rig(described, seed)
    name = f"{described.name}, change {seed}"
    rest = [simulated(built, "rest", NOISE_4, number) for number in range(REST_FRAMES)]
    touches = [simulated(built, kind) for kind in TOUCHES]
    began = perf_counter()
    try:
        outcome = calibrate_gel(described, [shot.frame.image for shot in rest])
    except CmpTactileError:
        nothing = float("nan")
        return GelCalibration(name, nothing, nothing, nothing, False, perf_counter() - began)
    seconds = perf_counter() - began
    # Tracked alike: what differs is the model.
    chain = Chain(built)
    # Before, rays miss each other by up to a millimetre; where in between the weighted point lies
    # is then a matter of the noise.
    middle = replace(described.triangulation, method="common_normal", max_ray_gap=LARGEST_GAP_M)
    before = _errors(chain, replace(described, triangulation=middle), rest, touches)
    after = _errors(chain, outcome.sensor or described, rest, touches)
    off, moved = after
    share = float(off[moved > MOVED_M].mean() / moved[moved > MOVED_M].mean())
    return GelCalibration(
        name,
        1e6 * float(before[0].mean()),
        1e6 * float(off.mean()),
        share,
        outcome.accepted,
        seconds,
    )


def _errors(
    chain: Chain, believed: SensorDescription, rest: list[Shot], touches: list[Shot]
) -> tuple[Points, Points]:
    """Errors of the displacement of markers, and how far they moved, m, with that model."""
    rig = StereoRig(believed)
    reference = Reference.average([chain.markers(shot, rig) for shot in rest], 1)
    off, moved = [], []
    for shot in touches:
        found = reference.surface(chain.markers(shot, rig)).displacement
        true = shot.truth.corners - rest[0].truth.corners
        seen = np.isfinite(found).all(axis=-1)
        off.append(np.linalg.norm((found - true)[seen], axis=-1))
        moved.append(np.linalg.norm(true[seen], axis=-1))
    return np.concatenate(off), np.concatenate(moved)
