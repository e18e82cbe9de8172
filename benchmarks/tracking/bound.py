#!/usr/bin/env python3
"""How far corners and virtual markers are from the best that the pixels allow.

The bound of Cramer and Rao is the smallest standard deviation that an unbiased estimate can have.
For a corner it is that of a shift, along x and y, of the pixels within half a checker of it; for a
virtual marker, of a shift across its gridline of the pixels in its share of the segment. The second
bound of a corner is that where the pixels' places may also be off by any quadratic function of
place: of an estimate that does not know how the edges bend. An estimate that also uses what lies
farther away can be better than these bounds. The pixels' gradients come from the rendered frame
without noise, the noise from the camera's settings.

How many times its reported deviation an error is, as a root mean square, stands beside ours: 1 is
right.

setup/run python3 benchmarks/tracking/bound.py                    all kinds, ours and the peers
setup/run python3 benchmarks/tracking/bound.py --kind clean       one kind
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import cv2
import numpy as np
from detectors import Detector, ours, peers, view_image
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from tables import CommandLine, head, line

from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.library import cases_of
from hard_frames.studio import PatternCase, PatternStudio

SENSOR = "sample_rig"
# Rounding to grey levels adds the variance of numbers spread evenly over one level.
ROUNDING = 1 / 12
# Half the side of the square of pixels that is looked at, in checkers.
REACH = 0.75
Array = NDArray[np.float64]


@dataclass
class Reported:
    """Errors over the deviations that are reported of them."""

    ratio: list[Array] = field(default_factory=list)

    def add(self, error: Array, std: Array) -> None:
        """Errors, px, and their deviations, px; NaN for what is not measured."""
        ratio = (error / std).ravel()
        self.ratio.append(ratio[np.isfinite(ratio)])

    def __str__(self) -> str:
        return f"{np.sqrt(np.mean(np.concatenate(self.ratio) ** 2)):.2f}"


@dataclass
class Squares:
    """Squared errors and squared bounds of the same markers, px^2; missing: not found."""

    error: list[Array] = field(default_factory=list)
    bound: list[Array] = field(default_factory=list)
    missing: int = 0

    def add(self, error: Array, bound: Array) -> None:
        """Those of one view; NaN for what is not found."""
        found = np.isfinite(error) & np.isfinite(bound)
        self.error.append(error[found])
        self.bound.append(bound[found])
        self.missing += int(np.count_nonzero(np.isfinite(bound) & ~found))

    def __str__(self) -> str:
        error, bound = np.concatenate(self.error), np.concatenate(self.bound)
        if not len(error):
            return "-"
        ratio = np.sqrt(error.mean() / bound.mean())
        missing = f", {self.missing} missing" if self.missing else ""
        return f"{np.sqrt(error.mean()):.4f} px, {ratio:.2f}{missing}"


class View:
    """Gradients of a view without noise, its truth, and the noise to come, grey levels."""

    def __init__(self, image: NDArray[np.uint8], truth: Grid, noise: float) -> None:
        self.truth = truth
        self._noise = noise
        height, width = image.shape
        y, x = np.arange(height, dtype=float), np.arange(width, dtype=float)
        spline = RectBivariateSpline(y, x, image.astype(float), kx=5, ky=5)
        self._slopes = np.stack([spline(y, x, dy=1), spline(y, x, dx=1)], axis=-1)
        self._shape = height, width

    def of_corners(self) -> tuple[Array, Array]:
        """Squared bounds (rows, cols) of the distance, px^2; NaN outside the view.

        The second are for unknown bends of the edges.
        """
        corners = self.truth.corners
        side = self._sides()
        found = np.full((2, *corners.shape[:2]), np.nan)
        for place in np.ndindex(corners.shape[:2]):
            offset, slope = self._around(corners[place], side[place])
            near = np.linalg.norm(offset, axis=-1) < side[place] / 2
            x, y = 2 * offset[near].T / side[place]
            ones = np.ones_like(x)
            for bound, terms in zip(found, ([ones], [ones, x * x, x * y, y * y]), strict=True):
                effect = [term[:, None] * slope[near] for term in terms]
                bound[place] = _variance(np.hstack(effect), self._noise)
        return found[0], found[1]

    def of_markers(self, lines: Array, axis: int) -> tuple[Array, Array]:
        """Squared bounds (a, b, n) across the gridlines along an axis, px^2, and normals."""
        corners = self.truth.corners
        way = np.diff(corners, axis=axis)
        length = np.linalg.norm(way, axis=-1)
        normal = np.stack([-way[..., 1], way[..., 0]], axis=-1) / length[..., None]
        found = np.full(lines.shape[:3], np.nan)
        for place in np.ndindex(found.shape):
            i, j, _ = place
            offset, slope = self._around(lines[place], length[i, j])
            share = length[i, j] / (lines.shape[2] + 1)
            along = offset @ (way[i, j] / length[i, j])
            across = offset @ normal[i, j]
            near = (np.abs(along) < share / 2) & (np.abs(across) < length[i, j] / 2)
            energy = float(((slope[near] @ normal[i, j]) ** 2).sum())
            found[place] = self._noise**2 / energy if energy > 0 else np.nan
        return found, normal

    def _sides(self) -> Array:
        """Side of the checkers at the corners (rows, cols), px."""
        steps = [np.gradient(self.truth.corners, axis=axis) for axis in (0, 1)]
        return np.asarray(np.mean([np.linalg.norm(step, axis=-1) for step in steps], axis=0))

    def _around(self, point: Array, side: float) -> tuple[Array, Array]:
        """Offsets and gradients (m, 2) of the pixels around a point; none near the view's edge."""
        reach = int(np.ceil(REACH * side)) if np.isfinite(point).all() else 0
        x, y = np.rint(np.nan_to_num(point)).astype(int)
        inside = reach <= x < self._shape[1] - reach and reach <= y < self._shape[0] - reach
        if not reach or not inside:
            return np.empty((0, 2)), np.empty((0, 2))
        rows, cols = np.mgrid[y - reach : y + reach + 1, x - reach : x + reach + 1]
        offset = np.stack([cols.ravel(), rows.ravel()], axis=-1) - point
        return offset, self._slopes[rows.ravel(), cols.ravel()]


def _variance(effect: Array, noise: float) -> float:
    """Trace of the smallest covariance of a shift, px^2, from its effect on the pixels, first two
    columns of (m, n), grey levels per px; the other columns: effects that are not known.
    """
    information = effect.T @ effect
    if len(effect) == 0 or np.linalg.matrix_rank(information) < len(information):
        return np.nan
    return float(noise**2 * np.trace(np.linalg.inv(information)[:2, :2]))


def _seen(**camera: float) -> Callable[[SensorDescription, int], list[PatternCase]]:
    def cases(sensor: SensorDescription, seed: int) -> list[PatternCase]:
        seen = CameraSettings(**camera)
        return [replace(case, camera=seen) for case in cases_of("clean", sensor, seed)]

    return cases


KINDS: dict[str, Callable[[SensorDescription, int], list[PatternCase]]] = {
    "clean": _seen(),
    "small spheres": lambda sensor, seed: cases_of("small spheres", sensor, seed),
    **{f"noise {noise:g}": _seen(read_noise=noise) for noise in (4.0, 16.0)},
    **{f"blur {blur:g}": _seen(blur=blur) for blur in (1.5, 3.0)},
    "low contrast": lambda sensor, seed: cases_of("low contrast", sensor, seed),
}


def _views(
    case: PatternCase, studio: PatternStudio
) -> Iterator[tuple[str, NDArray[np.uint8], View]]:
    """Each view of a case: its name, its image, and what it allows."""
    frame = studio.photograph(case)
    quiet = studio.photograph(replace(case, camera=replace(case.camera, read_noise=0.0)))
    noise = float(np.sqrt(case.camera.read_noise**2 + ROUNDING))
    for name, truth in frame.truth.items():
        view = View(view_image(quiet, name), truth, noise)
        yield name, view_image(frame, name), view


def corner_error(grid: Grid, truth: Grid) -> Array:
    """Squared distance (rows, cols) of the measured corners from their true places, px^2."""
    error = ((grid.corners - truth.corners) ** 2).sum(axis=-1)
    return np.where(grid.corner_status == Status.MEASURED, error, np.nan)


def marker_errors(grid: Grid, view: View) -> Iterator[tuple[Array, Array, Array]]:
    """Errors of measured virtual markers across the gridlines and their reported deviations, px,
    and squared bounds, px^2.
    """
    lines = (
        (1, grid.row_lines, view.truth.row_lines, grid.row_line_status, grid.row_line_std),
        (0, grid.col_lines, view.truth.col_lines, grid.col_line_status, grid.col_line_std),
    )
    for axis, found, true, status, std in lines:
        bound, normal = view.of_markers(true, axis)
        error = np.einsum("ijkd,ijd->ijk", found - true, normal)
        yield np.where(status == Status.MEASURED, error, np.nan), std, bound


def measure(kind: str, seeds: int, detectors: list[Detector]) -> list[str]:
    """A row of the table: kind, bounds of a corner, each detector, our virtual markers,
    and our errors over the reported deviations.
    """
    sensor, studio = load_sensor(SENSOR), PatternStudio()
    corners = {detector.name: Squares() for detector in detectors}
    markers, bounds, bent_bounds = Squares(), [], []
    of_corners, of_markers = Reported(), Reported()
    for seed in range(seeds):
        for case in KINDS[kind](sensor, seed):
            for name, image, view in _views(case, studio):
                bound, bent_bound = view.of_corners()
                bounds.append(bound[np.isfinite(bound)])
                bent_bounds.append(bent_bound[np.isfinite(bent_bound)])
                for number, detector in enumerate(detectors):
                    found = detector.detect(case.sensor, name, image, view.truth).grid
                    corners[detector.name].add(corner_error(found, view.truth), bound)
                    if number == 0:
                        off = found.corners - view.truth.corners
                        of_corners.add(off, found.corner_std[..., None])
                        for error, std, limit in marker_errors(found, view):
                            markers.add(error**2, limit)
                            of_markers.add(error, std)
    least = (f"{np.sqrt(np.concatenate(each).mean()):.4f} px" for each in (bounds, bent_bounds))
    return [kind, *least, *map(str, (*corners.values(), markers, of_corners, of_markers))]


def main() -> int:
    """Print the table."""
    parser = CommandLine(__doc__)
    parser.option("--kind", "default: all kinds", action="append", choices=KINDS)
    parser.option("--seeds", "of the cases", 2)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    detectors: list[Detector] = [ours()[0], *peers()]
    names = [detector.name for detector in detectors]
    print("RMS error, and how many times the bound that is")
    columns = (*names, "our virtual markers", "z of corners", "z of markers")
    print(head("frames", "bound", "bends unknown", *columns))
    for kind in arguments.kind or KINDS:
        print(line(*measure(kind, arguments.seeds, detectors)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
