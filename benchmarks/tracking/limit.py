#!/usr/bin/env python3
"""How near to the Cramer-Rao bound corners and virtual markers are found, by us and by peers.

setup/run python3 benchmarks/tracking/limit.py [--json FILE] [--frames 3]

The bound is the smallest standard deviation that any unbiased estimator can have that looks at
these pixels: from the Fisher information of a shift of what they show, by the derivatives of the
rendered picture and the noise of the camera, rounding to whole grey levels included.
A corner's pixels are those within half a pitch of it along rows and columns, a virtual marker's
those of its own share of the gridline and within half a pitch across it.  An estimator that looks
further, along the gridline or at neighbours, may be better than that.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from detectors import Detector, ours, peers
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.hard_frames.case import (
    PatternCase,
    PatternStudio,
    deform,
    deformation_of,
    pattern_rig,
)
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import Checkerboard
from cmp_tactile_simulation.rendering.renderer import RenderedFrame, Renderer

Array = NDArray[np.float64]

DEFORMED = ("rest", "press", "twist")
SAMPLES = 4
# Variance of rounding to whole grey levels.
ROUNDING = 1 / 12
# A detection further off is another corner.
WRONG_PX = 2.0


@dataclass(frozen=True)
class Condition:
    """What a row of the table is of."""

    name: str
    camera: CameraSettings
    sensor: Callable[[], SensorDescription] = lambda: load_sensor("sample_rig")


def conditions() -> Iterator[Condition]:
    """From easy to hard, one thing at a time."""
    clean = CameraSettings()
    for noise in (1.0, 2.0, 4.0, 8.0, 16.0):
        yield Condition(f"noise {noise:g}", replace(clean, read_noise=noise))
    for blur in (1.0, 1.5, 2.0, 3.0):
        yield Condition(f"blur {blur:g} px", replace(clean, blur=blur))
    for contrast in (80.0, 40.0):
        camera = replace(clean, dark_level=60.0, light_level=60.0 + contrast)
        yield Condition(f"contrast {contrast:g}", camera)
    for side in (14, 28):
        yield Condition(
            f"{side} x {side} corners", clean, lambda side=side: pattern_rig(side, side)
        )


@dataclass(frozen=True)
class Derivatives:
    """Of one view without noise: how a pixel changes with a shift, grey levels per px (H, W)."""

    along_x: Array
    along_y: Array
    variance: float

    @classmethod
    def views(cls, case: PatternCase, truth: Mapping[str, Grid]) -> dict[str, Derivatives]:
        """By the picture rendered once more, shifted by a part of a pixel to each side."""
        renderer = Renderer(case.sensor, Checkerboard(case.sensor.pattern), SAMPLES)
        rendered = renderer.render(deform(case.sensor, case.deformation))
        still = replace(case.camera, read_noise=0.0)

        def shifted(axis: int, step: int) -> NDArray[np.uint8]:
            grey = np.roll(rendered.grey, step, axis)
            unused = np.random.default_rng(0)
            return expose([RenderedFrame(grey, rendered.fineness)], still, unused)

        def slope(axis: int, grid: Grid) -> Array:
            after, before = (split_frame(shifted(axis, k), grid.placement) for k in (1, -1))
            return (after.astype(float) - before) * rendered.fineness / 2

        variance = case.camera.read_noise**2 + ROUNDING
        return {name: cls(slope(1, grid), slope(0, grid), variance) for name, grid in truth.items()}


@dataclass
class Errors:
    """Squared errors, px^2: of corners per coordinate, and of virtual markers across the line."""

    corners: list[float]
    markers: list[float]

    def rms(self) -> tuple[float, float]:
        """Of both; NaN where there is none."""
        return _root_mean(self.corners), _root_mean(self.markers)


def corner_bounds(grid: Grid, slopes: Derivatives) -> Array:
    """Variance per coordinate, px^2, (rows, cols); NaN at the border, where pixels are missing."""
    along_col, along_row = np.gradient(grid.corners, axis=(0, 1))
    found = np.full(grid.corners.shape[:2], np.nan)
    for i, j in np.ndindex(found.shape):
        axes = np.stack([along_row[i, j], along_col[i, j]], axis=1)
        information = _information(slopes, grid.corners[i, j], axes, (0.5, 0.5))
        if information is not None:
            found[i, j] = np.trace(np.linalg.inv(information)) / 2
    found[[0, -1]] = found[:, [0, -1]] = np.nan
    return found


def marker_bounds(grid: Grid, slopes: Derivatives) -> tuple[Array, Array]:
    """Variance across the line, px^2, of the virtual markers of rows and of columns."""
    along_col, along_row = np.gradient(grid.corners, axis=(0, 1))
    found = []
    for lines, along, across in (
        (grid.row_lines, along_row, along_col),
        (grid.col_lines, along_col, along_row),
    ):
        bound = np.full(lines.shape[:3], np.nan)
        share = 0.5 / (lines.shape[2] + 1)
        for i, j, k in np.ndindex(bound.shape):
            axes = np.stack([along[i, j], across[i, j]], axis=1)
            information = _information(slopes, lines[i, j, k], axes, (share, 0.5))
            if information is not None:
                normal = _normal(along[i, j])
                bound[i, j, k] = 1 / max(normal @ information @ normal, 1e-12)
        found.append(bound)
    return found[0], found[1]


def _information(
    slopes: Derivatives, centre: Array, axes: Array, reach: tuple[float, float]
) -> Array | None:
    """Fisher information (2, 2), 1 / px^2, of a shift of the pixels within reach along the axes.

    axes: columns, px of a pitch.  None where the point is not known or lies at the edge.
    """
    if not (np.isfinite(centre).all() and np.isfinite(axes).all()):
        return None
    half = np.abs(axes) @ np.array(reach)
    low, high = np.floor(centre - half).astype(int), np.ceil(centre + half).astype(int) + 1
    if (low < 0).any() or (high > slopes.along_x.shape[::-1]).any():
        return None
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    place = np.linalg.solve(axes, np.stack([x - centre[0], y - centre[1]]).reshape(2, -1))
    inside = (np.abs(place) <= np.array(reach)[:, None]).all(axis=0)
    window = slice(low[1], high[1]), slice(low[0], high[0])
    slope = np.stack([slopes.along_x[window].ravel(), slopes.along_y[window].ravel()])[:, inside]
    return np.asarray(slope @ slope.T / slopes.variance)


def _normal(along: Array) -> Array:
    turned = np.array([-along[1], along[0]])
    return turned / np.linalg.norm(turned)


def add_errors(errors: Errors, grid: Grid, truth: Grid, bound: Array) -> None:
    """Of what was found right and has a bound."""
    off = grid.corners - truth.corners
    known = (grid.corner_status == Status.MEASURED) & np.isfinite(bound)
    known &= np.linalg.norm(off, axis=-1) < WRONG_PX
    errors.corners += (np.sum(off[known] ** 2, axis=-1) / 2).tolist()
    along_col, along_row = np.gradient(truth.corners, axis=(0, 1))
    for found, true, along, status in (
        (grid.row_lines, truth.row_lines, along_row[:, :-1], grid.row_line_status),
        (grid.col_lines, truth.col_lines, along_col[:-1], grid.col_line_status),
    ):
        if found.shape != true.shape:
            continue
        normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        across = np.sum((found - true) * normal[:, :, None], axis=-1)
        right = (status == Status.MEASURED) & (np.abs(across) < WRONG_PX)
        errors.markers += (across[right] ** 2).tolist()


def measure(condition: Condition, detectors: list[Detector], frames: int) -> dict[str, float]:
    """Bounds, and the error of each detector, px."""
    sensor, studio = condition.sensor(), PatternStudio(SAMPLES)
    corners: list[float] = []
    markers: list[float] = []
    errors = {detector.name: Errors([], []) for detector in detectors}
    for number in range(frames):
        kind = DEFORMED[number % len(DEFORMED)]
        bent = deformation_of(kind, sensor.pattern, number)
        case = PatternCase(kind, sensor, bent, condition.camera, frame=number)
        frame = studio.photograph(case)
        slopes = Derivatives.views(case, frame.truth)
        for view, truth in frame.truth.items():
            bound = corner_bounds(truth, slopes[view])
            corners += bound[np.isfinite(bound)].tolist()
            for lines in marker_bounds(truth, slopes[view]):
                markers += lines[np.isfinite(lines)].tolist()
            image = split_frame(frame.image, truth.placement)
            for detector in detectors:
                if detector.able(sensor):
                    grid = detector.detect(sensor, view, image, truth).grid
                    add_errors(errors[detector.name], grid, truth, bound)
    found = {"corner bound": _root_mean(corners), "marker bound": _root_mean(markers)}
    for name, error in errors.items():
        found[f"{name}: corner"], found[f"{name}: marker"] = error.rms()
    return found


def _root_mean(squares: list[float]) -> float:
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def main() -> None:
    """Measure, print, and keep."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=3, help="of each row (%(default)d)")
    parser.add_argument("--only", default="", help="rows that contain this text")
    parser.add_argument("--json", type=Path, metavar="FILE", help="file to write the figures into")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    detectors: list[Detector] = [*ours()[:1], *peers()]
    names = [detector.name for detector in detectors]
    print(f"| case | bound, px | {' | '.join(names)} | markers: bound, px | {names[0]} |")
    print("|---" * (len(names) + 4) + "|")
    kept = {}
    for condition in conditions():
        if options.only not in condition.name:
            continue
        found = kept[condition.name] = measure(condition, detectors, options.frames)
        ratios = (found[f"{name}: corner"] / found["corner bound"] for name in names)
        marker = found[f"{names[0]}: marker"] / found["marker bound"]
        print(
            f"| {condition.name} | {found['corner bound']:.4f} | "
            + " | ".join(f"{ratio:.2f}" for ratio in ratios)
            + f" | {found['marker bound']:.4f} | {marker:.2f} |",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
