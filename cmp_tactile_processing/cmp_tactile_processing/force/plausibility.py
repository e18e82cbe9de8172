"""Whether a frame can be one of this gel, and whether something touches it outside the markers.

`Plausibility` compares displacements and forces with limits that follow from the sensor's
description.  `BorderContact` looks for loads outside the marker area: force nodes lie over the
markers only, so these are taken for forces at the border that are not there.  Two explanations of
a frame are weighed by their evidence, the probability of the measured displacement: smooth forces
inside alone, or smooth forces inside and outside.  How large each of them is expected to be, and
how large the noise is, the frame itself determines.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem
from cmp_tactile_processing.force.traction_spectrum import (
    MIN_NOISE_SQUARED,
    TANGENTIAL_SHARE,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern

# How far a marker may move, over the thickness of the gel at the apex.  The base does not give way,
# so nothing is pressed deeper than to it.  A gel that is described as linear has no such end: by
# its law small indenters and scaled loads of 50 N reach 1.7, and their force is what was put on.
FARTHEST, FARTHEST_LINEAR = 1.0, 2.0
# Markers that hardly sink stay in their order: presses, drags and twists as far as friction holds
# change their distance along the line that joins them to 0.5 to 1.6 of what it was.  Markers that
# change places have 0 or less, and a marker that is taken for the next one leaves 2 on its other
# side.  Deeper in, steep flanks part them farther.
MOST_CHANGED, SHALLOW = 0.8, 0.15
# What no force explains, over the distance of the markers: of all together (root mean square), and
# between two neighbours.  Contacts leave 0.01, hand-made fields that no gel shows 0.03; a numbering
# that is off by one leaves 0.1 to 0.4 of the whole, and up to 1 where it begins.
UNEXPLAINED, UNEXPLAINED_STEP = 0.1, 1 / 3
# A gel that is bonded to its base tears open inside at a tension of 5/6 of Young's modulus (Gent
# and Lindley 1958), and what holds on to it by suction lets go at the pressure of the air.
TEARS_AT, AIR_PA = 5 / 6, 101325.0

# To be raised with every change that alters the arrays of the same sensor.
VERSION = 3
# What a load outside does fades over the thickness of the gel: a quarter of it resolves that.
SPACING_PER_THICKNESS = 0.25
# No more across a thin gel, by far: what is farther outside than the gel is thick does not matter.
MOST_CELLS = 32
# Coarser than that of the force nodes: only the shape of what loads outside do counts.
DENSITY = MeshDensity(across=16, rim=2, depth=3)
# Of forces inside and outside, m.
SMOOTHING_LENGTH = 1.5e-3
# Along each side; more would show the same.
MOST_MARKERS = 20
# Ways in which loads outside move the markers that count; later ones are a tenth as strong.
MODES = 40
# Variances of the forces inside and outside that are tried, each times its largest response.
INSIDE, OUTSIDE = np.logspace(1, 8, 8), np.logspace(1, 9, 17)
# Motions of a rigid body.
RIGID = 6
# Share of the displacements without which it is not determined.
LEAST_KNOWN = 0.7
# Logarithm of how much likelier a force outside must make the frame.  Noise alone reaches 1 in
# 100 frames; the mesh is wrong by a share of the displacement, which loads outside explain in part.
LEAST_EVIDENCE, MODEL_ERROR = 10.0, 2e-3


class Plausibility:
    """Compares displacements and forces with limits that follow from one sensor's description.

    markers: the grid of the markers.
    """

    def __init__(self, sensor: SensorDescription, markers: SurfaceGrid) -> None:
        elastomer, pattern = sensor.elastomer, sensor.pattern
        thickness = elastomer.size[2]
        linear = elastomer.model == "linear"
        self._farthest = thickness * (FARTHEST_LINEAR if linear else FARTHEST)
        self._shallow = thickness * SHALLOW
        self._pitch = pattern.pitch
        rest = _rest(pattern, markers)
        apart = rest[1:] - rest[:-1], rest[:, 1:] - rest[:, :-1]
        self._directions = [step / (step**2).sum(axis=-1, keepdims=True) for step in apart]
        area = float(np.prod(markers.extent))
        # Gent's stiffness of a bonded layer: pressed on all over, it gives way all through at this.
        wide = np.sqrt(area) / (4 * thickness)
        self._most_pressed = elastomer.young * (1 + 2 * wide**2) * area
        self._most_pulled = min(TEARS_AT * elastomer.young, AIR_PA) * area

    def allows_displacement(self, moved: NDArray[np.float64]) -> bool:
        """Whether a gel can move so: moved (rows, cols, 3) m, NaN where not known."""
        # Of one view the depth is not known, nor is it needed here.
        depth = np.where(np.isnan(moved[..., 2]), 0.0, moved[..., 2])
        # Without the depth steep flanks are not known either: only what changes places is refused.
        most = 1.0 if np.isnan(moved[..., 2]).all() else MOST_CHANGED
        flat = np.dstack([moved[..., :2], depth])
        if ((flat**2).sum(axis=-1) > self._farthest**2).any():
            return False
        sunk = np.abs(depth) > self._shallow
        either = sunk[1:] | sunk[:-1], sunk[:, 1:] | sunk[:, :-1]
        steps = flat[1:] - flat[:-1], flat[:, 1:] - flat[:, :-1]
        for direction, step, deep in zip(self._directions, steps, either, strict=True):
            change = np.abs((step * direction).sum(axis=-1))
            if ((change > most) & ~deep).any():
                return False
        return True

    def allows_force(self, force: NDArray[np.float64], unexplained: NDArray[np.float64]) -> bool:
        """Whether a gel can bear forces (nodes, 3) N that leave so much of its motion open.

        unexplained (rows, cols, 3) m: displacement beyond what the forces explain, NaN where not
        known.
        """
        if np.isnan(unexplained[..., 2]).all():
            # Of one view the forces are inferred: what is open about them is in their deviations.
            return True
        pulled = np.maximum(force[:, 2], 0.0).sum()
        pressed = np.maximum(-force[:, 2], 0.0).sum()
        if pulled > self._most_pulled or pressed > self._most_pressed:
            return False
        known = unexplained[np.isfinite(unexplained)]
        if float(known @ known) > (UNEXPLAINED * self._pitch) ** 2 * len(known):
            return False
        flat, most = unexplained[..., :2], UNEXPLAINED_STEP * self._pitch
        steps = flat[1:] - flat[:-1], flat[:, 1:] - flat[:, :-1]
        return not any((np.abs(step) > most).any() for step in steps)


def _rest(pattern: Pattern, markers: SurfaceGrid) -> NDArray[np.float64]:
    """Markers at rest, (rows, cols, 3) m."""
    points = markers.points
    height = pattern.surface.height(points)
    return np.column_stack([points, height]).reshape(markers.rows, markers.cols, 3)


class BorderContact:
    """Looks for forces outside the markers of one sensor; what it needs is kept on disk.

    cache_dir: see ElasticModel.  The noise is that of sensor.force.
    """

    def __init__(
        self, sensor: SensorDescription, elastic: ElasticModel, cache_dir: Path | None = None
    ) -> None:
        parameters = sensor.force
        noise = (parameters.noise_in_plane, parameters.noise_in_plane, parameters.noise_depth)
        self._elastic = elastic
        self._used = _used_markers(elastic.markers)
        count = len(self._used)
        self._noise = np.tile(noise, count)
        problem = _outside_problem(ElasticProblem.from_sensor(sensor), sensor.elastomer.size)
        outside = _is_outside(problem)
        free = max(3 * count - RIGID, 0)
        self._modes = min(MODES, free // 4, 3 * int(outside.sum()))
        if not self._modes:
            return
        key = {"version": VERSION, "noise": noise, "problem": problem.key}
        shapes = {
            "basis": (free, 3 * count),
            "inside": (free,),
            "modes": (len(INSIDE), self._modes, free),
            "outside": (len(INSIDE), self._modes),
        }
        arrays = cached_arrays(
            cache_dir, "border_contact", key, shapes, lambda: self._build(problem, outside)
        )
        # Rounded to 1e-7 of the displacement, a thousandth of the noise.
        self._basis = arrays["basis"].astype(np.float32)
        self._probe = arrays["modes"].astype(np.float32)
        inside = 1 + INSIDE[:, None] * arrays["inside"]
        self._shrink, self._volume = 1 / inside, np.log(inside).sum(axis=1)
        outside_part = OUTSIDE[:, None, None] * arrays["outside"]
        self._gain = outside_part / (1 + outside_part)
        self._more_volume = np.log1p(outside_part).sum(axis=2)

    def reaches_beyond(self, displacement: NDArray[np.float64], force: NDArray[np.float64]) -> bool:
        """Whether these displacements are those of a force outside, at least in part.

        displacement (rows, cols, 3) m, NaN where not known; force (nodes, 3) N as found inside,
        the displacement of which serves there.  False where so much is not known, as the depth of a
        sensor with one view, that it cannot be determined.
        """
        moved = displacement.reshape(-1, 3)[self._used]
        known = np.isfinite(moved)
        if not self._modes or known.mean() < LEAST_KNOWN:
            return False
        if not known.all():
            with one_blas_thread():
                predicted = self._elastic.displacement(force).reshape(-1, 3)[self._used]
            moved = np.where(known, moved, predicted)
        moved = (moved.ravel() / self._noise).astype(np.float32)
        with one_blas_thread():
            parts = self._basis @ moved
            outside = (self._probe @ parts).astype(np.float64) ** 2
        parts = parts.astype(np.float64)
        misfit = self._shrink @ parts**2
        alone = _log_evidence(misfit, self._volume, len(parts)).max()
        explained = np.einsum("olm,lm->ol", self._gain, outside)
        both = _log_evidence(misfit - explained, self._volume + self._more_volume, len(parts)).max()
        least = LEAST_EVIDENCE + 0.5 * MODEL_ERROR**2 * float(parts @ parts)
        return bool(both - alone > least)

    def _build(self, problem: ElasticProblem, outside: NDArray[np.bool_]) -> dict[str, Any]:
        elastic = self._elastic
        rows = (3 * self._used[:, None] + np.arange(3)).ravel()
        with one_blas_thread():
            beyond = problem.expand(problem.solve())[rows][:, np.repeat(outside, 3)]
            beyond = _of_smooth(beyond / self._noise[:, None], problem.nodes, outside)
            within = elastic.compliance[rows] / self._noise[:, None]
            within = _of_smooth(within, elastic.nodes, np.ones(len(within.T) // 3, dtype=bool))
            # A camera that was knocked, or a reference of another day, is no force outside.
            rigid = _rigid_motions(elastic.markers)[rows] / self._noise[:, None]
            free = np.linalg.qr(rigid, mode="complete")[0][:, RIGID:]
            within = free.T @ within
            values, vectors = eigh(within @ within.T, check_finite=False)
            values = np.maximum(values / values[-1], 0.0)
            basis = vectors.T @ free.T
            modes = [_strongest(basis @ beyond, 1 + size * values, self._modes) for size in INSIDE]
        strength = np.stack([part for _, part in modes])
        return {
            "basis": basis,
            "inside": values,
            "modes": np.stack([part for part, _ in modes]),
            "outside": strength / strength.max(),
        }


def _log_evidence(misfit: Any, volume: Any, count: int) -> NDArray[np.float64]:
    """Of data (count,) with this misfit, for the noise that is likeliest."""
    noise = np.maximum(misfit / count, MIN_NOISE_SQUARED)
    return np.asarray(-0.5 * (count * np.log(noise) + misfit / noise + volume))


def _of_smooth(
    response: NDArray[np.float64], nodes: SurfaceGrid, some: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Response (data, 3 k) to independent unknowns that make smooth forces on some nodes."""
    prior = smoothness(nodes, SMOOTHING_LENGTH)[np.ix_(some, some)]
    components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
    lower = np.linalg.cholesky(np.kron(prior, components))
    return np.asarray(solve_triangular(lower, response.T, lower=True, check_finite=False).T)


def _strongest(
    response: NDArray[np.float64], variance: NDArray[np.float64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (count, data) in data of such variances (data,) that a response moves most.

    Data times them have variance 1; and by which variance (count,) the response adds to it.
    """
    whitened = response / np.sqrt(variance)[:, None]
    last = whitened.shape[1] - 1
    square = whitened.T @ whitened
    values, vectors = eigh(square, check_finite=False, subset_by_index=(last - count + 1, last))
    values = np.maximum(values, 1e-12 * values[-1])
    directions = (whitened @ vectors) / np.sqrt(values * variance[:, None])
    return np.ascontiguousarray(directions.T), values


def _outside_problem(problem: ElasticProblem, size: tuple[float, float, float]) -> ElasticProblem:
    """The problem with force nodes all over the block instead of over the markers."""
    spacing = SPACING_PER_THICKNESS * size[2]
    cells = [min(max(4, round(side / spacing)), MOST_CELLS) for side in size[:2]]
    extent = [side * (1 - 2 / n) for side, n in zip(size, cells, strict=False)]
    grid = SurfaceGrid(cells[1] - 1, cells[0] - 1, (extent[0], extent[1]))
    return replace(problem, nodes=grid, density=DENSITY)


def _is_outside(problem: ElasticProblem) -> NDArray[np.bool_]:
    half = np.array(problem.markers.extent) / 2
    return np.asarray((np.abs(problem.nodes.points) > half).any(axis=1))


def _used_markers(markers: SurfaceGrid) -> NDArray[np.intp]:
    """Numbers of the markers that are used: of a fine grid every second, or third."""
    numbers = np.arange(markers.rows * markers.cols).reshape(markers.rows, markers.cols)
    steps = [-(-count // MOST_MARKERS) for count in numbers.shape]
    return numbers[:: steps[0], :: steps[1]].ravel()


def _rigid_motions(markers: SurfaceGrid) -> NDArray[np.float64]:
    """Displacements (3 markers, 6) of the markers by small rigid motions of all of them."""
    points = np.zeros((markers.rows * markers.cols, 3))
    points[:, :2] = markers.points
    along = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
    about = [np.cross(axis, points) / max(markers.extent) for axis in np.eye(3)]
    return np.stack([motion.ravel() for motion in (*along, *about)], axis=1)
