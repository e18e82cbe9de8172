"""Which pattern to print for a camera: pitch, virtual markers and resolution swept together."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError, ReferenceFramesError
from cmp_tactile_processing.printing.advice import checker_sides_px
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_processing.surface.dense import DenseSurface, SurfaceInterpolator
from cmp_tactile_simulation.rendering.deformed_surface import DeformedSurface
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from paper.chain import Chain, Measurement
from paper.experiment import Case, Workplace
from paper.film import Film, Truth
from paper.method import CMP
from paper.pattern_choice_fields import FIELDS, WAVELENGTHS, deformations
from paper.pattern_choice_rig import CONDITIONS, STANDARD_WIDTH, condition, of_width, printed
from paper.pattern_choice_score import NODES, field_rms, true_displacement, wave_gains
from paper.scoring import displacement_error, score_markers

__all__ = ["CHECK_RIG", "POINTS", "RIG", "STANDARD_POINTS", "cases", "measured"]

# What the recommendation is read from, and what it is checked on.
RIG, CHECK_RIG = "prototype", "sample_rig"
WIDTHS = (512, 640, 1024, 1280, 1600)
CHECK_WIDTHS = (640, 1024)
CORNERS = (8, 12, 16, 20, 24, 28, 32, 36, 40, 46, 53, 60)
FAST_WIDTHS, FAST_CORNERS = (640, 1024), (12, 20, 36)
CHECK_CORNERS = (12, 20, 28, 32, 36, 46)
STANDARD_POINTS = 6
FEW_POINTS = (0, STANDARD_POINTS)
POINTS, POINTS_CORNERS = (0, 1, 2, 4, STANDARD_POINTS, 10, 16), (12, 20, 28, 40)
CELLS_PER_CASE = 4

REST_FRAMES = 4
SEEDS = 2
# Beyond the outermost corners; all nodes lie within, but for rounding.
MARGIN = 1e-4


def cases(place: Workplace) -> Sequence[Case]:
    """The prototype's optics with all patterns, the sample rig's to check what they teach."""
    if place.fast:
        return [_case(RIG, width, FAST_CORNERS, FEW_POINTS) for width in FAST_WIDTHS]
    found = []
    others = [corners for corners in CORNERS if corners not in POINTS_CORNERS]
    for width in WIDTHS:
        found.append(_case(RIG, width, POINTS_CORNERS, POINTS))
        for start in range(0, len(others), CELLS_PER_CASE):
            part = tuple(others[start : start + CELLS_PER_CASE])
            found.append(_case(RIG, width, part, FEW_POINTS))
    found += [_case(CHECK_RIG, width, CHECK_CORNERS, (STANDARD_POINTS,)) for width in CHECK_WIDTHS]
    return found


def _case(rig: str, width: int, corners: tuple[int, ...], points: tuple[int, ...]) -> Case:
    name = f"{rig}-{width}-{corners[0]}"
    seconds = len(corners) * (3.0 + 1.5 * len(points)) * (0.4 + 0.6 * width / STANDARD_WIDTH)
    return Case(name, measured, (rig, width, corners, points), seconds)


def measured(
    place: Workplace, rig: str, width: int, corners: Sequence[int], points: Sequence[int]
) -> dict[str, NDArray[np.float64]]:
    """All figures of some patterns before one camera, stacked over `corners`.

    side_least, side_mean (n,) px.  visible, lost, wrong (n, conditions): markers of all
    deformations, views and seeds; lost ones have no place, wrong ones another's number.
    marker (n, conditions): RMS error of a marker, m.  field (n, points, conditions, FIELDS): RMS
    error of the dense displacement, m.  gain (n, points, waves).  seconds (n, points): processor
    time of a frame that is followed.
    """
    cells = [_cell(place, of_width(load_sensor(rig), width), n, points) for n in corners]
    stacked = {name: np.array([cell[name] for cell in cells]) for name in cells[0]}
    return {
        "corners": np.array(corners, np.float64),
        "points": np.array(points, np.float64),
        "width": np.array(float(width)),
        **stacked,
    }


def _cell(
    place: Workplace, camera: SensorDescription, corners: int, points: Sequence[int]
) -> dict[str, NDArray[np.float64]]:
    sensor = printed(camera, corners, STANDARD_POINTS)
    sides = np.concatenate(list(checker_sides_px(sensor).values()))
    cell = _nothing(len(points))
    cell["side_least"][...], cell["side_mean"][...] = sides.min(), sides.mean()
    roll = _Roll(place, sensor)
    for k, count in enumerate(points):
        bench = _Bench.from_sensor(printed(camera, corners, count))
        if bench is None:
            break
        for c, name in enumerate(CONDITIONS):
            if count == STANDARD_POINTS or name == "good":
                _judge(bench, roll, (k, c), cell)
    return cell


def _nothing(points: int) -> dict[str, NDArray[np.float64]]:
    """No marker found, no field known."""
    conditions = len(CONDITIONS)
    return {
        "side_least": np.zeros(()),
        "side_mean": np.zeros(()),
        "visible": np.zeros(conditions),
        "lost": np.full(conditions, np.nan),
        "wrong": np.zeros(conditions),
        "marker": np.full(conditions, np.nan),
        "field": np.full((points, conditions, len(FIELDS)), np.nan),
        "gain": np.full((points, len(WAVELENGTHS)), np.nan),
        "seconds": np.full(points, np.nan),
    }


class _Roll:
    """All surfaces of a pattern, rendered once, exposed as often as needed."""

    def __init__(self, place: Workplace, sensor: SensorDescription) -> None:
        self._film = Film(sensor, "cmp")
        self._width = sensor.image.width
        self.surfaces = deformations(place, sensor.pattern)
        self.truths = {name: true_displacement(s) for name, s in self.surfaces.items()}
        self.markers: dict[str, Truth] = {
            name: self._film.truth(self.surfaces[name]) for name in FIELDS
        }
        self._frames: dict[str, RenderedFrame] = {
            name: self._film.rendered(surface)
            for name, surface in {
                "rest": DeformedSurface.rest(sensor.pattern),
                **self.surfaces,
            }.items()
        }

    def image(self, name: str, number: int, light: str) -> NDArray[np.uint8]:
        """A frame; `number` tells frames of the same surface apart."""
        index = 100 * list(self._frames).index(name) + number
        return self._film.exposed(self._frames[name], index, condition(light, self._width))


@dataclass(frozen=True)
class _Bench:
    """The chain on one pattern, and the dense surface."""

    chain: Chain
    dense: SurfaceInterpolator
    points: int

    @classmethod
    def from_sensor(cls, sensor: SensorDescription) -> _Bench | None:
        """None where the tracker refuses checkers of a few pixels."""
        try:
            chain = Chain(sensor, CMP)
        except GeometryError:
            return None
        pattern = sensor.pattern
        dense = SurfaceInterpolator(pattern.shape, pattern.pitch, NODES, MARGIN)
        return cls(chain, dense, pattern.points_per_segment)

    def measure(self, image: NDArray[np.uint8]) -> tuple[Measurement, DenseSurface, float]:
        """All that a frame tells, and the processor time, s, that it took."""
        start = time.thread_time()
        measurement = self.chain.measure(image)
        dense = self.dense.interpolate(measurement.surface)
        return measurement, dense, time.thread_time() - start


def _judge(
    bench: _Bench, roll: _Roll, at: tuple[int, int], cell: dict[str, NDArray[np.float64]]
) -> None:
    """Fill in what one choice of virtual markers (first of `at`) gives in one light (second)."""
    k, c = at
    light = list(CONDITIONS)[c]
    standard = bench.points == STANDARD_POINTS
    if standard:
        cell["visible"][c] = SEEDS * _visible(roll)
    try:
        bench.chain.set_reference([roll.image("rest", i, light) for i in range(REST_FRAMES)])
    except ReferenceFramesError:
        return
    if standard:
        cell["lost"][c] = 0
    errors, seconds = [], []
    for f, name in enumerate(FIELDS):
        squares = []
        # Each deformation comes as a knock: the first frame is detected, the next is followed.
        bench.chain.reset()
        for seed in range(SEEDS):
            measurement, dense, took = bench.measure(roll.image(name, seed, light))
            squares.append(field_rms(dense, roll.truths[name]) ** 2)
            seconds.append(took)
            if standard:
                errors.append(_marker_squares(measurement, roll.markers[name]))
                score = score_markers(measurement.grids, roll.markers[name].grids)
                cell["lost"][c] += _lost(measurement, roll.markers[name])
                cell["wrong"][c] += score.wrong
        cell["field"][k, c, f] = np.sqrt(np.mean(squares))
    if standard:
        known = np.concatenate(errors)
        cell["marker"][c] = np.sqrt(known.mean()) if len(known) else np.nan
    if light == "good":
        cell["seconds"][k] = np.median(seconds[1::SEEDS])
        cell["gain"][k] = _gains(bench, roll)


def _visible(roll: _Roll) -> int:
    return sum(
        int(np.isfinite(grid.corners[..., 0]).sum())
        for truth in roll.markers.values()
        for grid in truth.grids.values()
    )


def _lost(measurement: Measurement, truth: Truth) -> int:
    """Markers that a view shows and for which it has no place."""
    return sum(
        int((np.isfinite(grid.corners) & np.isnan(measurement.grids[name].corners))[..., 0].sum())
        for name, grid in truth.grids.items()
    )


def _marker_squares(measurement: Measurement, truth: Truth) -> NDArray[np.float64]:
    """Squared lengths of the errors of all markers that were measured, m^2."""
    squared = (displacement_error(measurement.surface, truth.surface) ** 2).sum(axis=-1)
    return np.asarray(squared[np.isfinite(squared)])


def _gains(bench: _Bench, roll: _Roll) -> NDArray[np.float64]:
    gains = []
    for which in (0, 1):
        name = f"waves {which}"
        bench.chain.reset()
        dense = bench.measure(roll.image(name, 0, "good"))[1]
        gains.append(wave_gains(dense, roll.truths[name], which))
    return np.asarray(np.mean(gains, axis=0))
