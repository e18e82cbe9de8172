"""Time of triangulation, and OpenCV's on the same points in the same run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter

import cv2
import numpy as np
from optics_chain import Chain, Points, Shot, opencv_points, simulated, with_optics

from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.refraction import RayModel
from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_processing.stereo.triangulation import triangulate

REPEATS = 1000
NOISE_PX = 0.02


@dataclass(frozen=True)
class Speed:
    """Shortest times of many runs, ms, and what else there is to tell."""

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
