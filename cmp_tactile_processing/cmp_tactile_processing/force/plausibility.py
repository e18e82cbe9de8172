"""Whether a frame can be one of this gel, and whether something touches it outside the markers.

`Plausibility` compares displacements and forces with limits that follow from the sensor's
description.  `BorderContact` looks for loads outside the marker area: force nodes lie over the
markers only, so these are taken for forces at the border that are not there.  Two explanations of
a frame are weighed by their evidence, the probability of the measured displacement: smooth forces
inside alone, or smooth forces inside and outside.  How large each of them is expected to be, and
how large the noise is, the frame itself determines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh, solve_triangular

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.cache.kernels import kernel, kernel_part, plain
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.mirror_symmetry import (
    PARITIES,
    SparseRows,
    product_of_parts,
)
from cmp_tactile_processing.elastic.model import ElasticModel, ElasticProblem
from cmp_tactile_processing.force.traction_spectrum import (
    MIN_NOISE_SQUARED,
    TANGENTIAL_SHARE,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern

Array = NDArray[np.float64]

# Largest displacement of a marker over the thickness of the gel at the apex.  The base is rigid, so
# nothing is pressed deeper.
MAX_DISPLACEMENT_RATIO = 1.0
# A gel that is described as linear has no such limit: by its law small indenters and scaled loads
# of 50 N reach 1.7, and their force is right.
MAX_LINEAR_DISPLACEMENT_RATIO = 2.0
# Markers that hardly sink stay in their order: presses, drags and twists up to the limit of
# friction change the distance of neighbours, along their line, to 0.5 to 1.6 of what it was.
# Exchanged markers have 0 or less, and a marker taken for the next one leaves 2 on its other side.
MAX_DISTANCE_CHANGE = 0.8
# Depth over the thickness below which this holds: steep flanks separate deeper markers.
MAX_SHALLOW_RATIO = 0.15
# Residual that no force explains, over the distance of the markers: root mean square of all.
# Contacts leave 0.01, invented fields that no gel shows 0.03; a numbering that is off by one leaves
# 0.1 to 0.4.
MAX_RESIDUAL_PITCHES = 0.1
# Between two neighbours; a numbering that is off by one leaves up to 1 where it begins.
MAX_RESIDUAL_STEP_PITCHES = 1 / 3
# A gel that is bonded to its base tears inside at this tension over Young's modulus (Gent and
# Lindley 1958).
TEARING_TENSION_RATIO = 5 / 6
# An object that adheres by suction lets go at the pressure of the air, Pa.
AIR_PRESSURE_PA = 101325.0

# To be raised with every change that alters the arrays of the same sensor.
VERSION = 4
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
# Prior variances that are tried for the forces inside and outside, each times its largest response.
INSIDE_VARIANCES = np.logspace(1, 8, 8)
OUTSIDE_VARIANCES = np.logspace(1, 9, 17)
# Of a rigid motion less than this share is rounding: it belongs to one parity alone.
LEAST_RIGID = 1e-9
# Share of the displacements without which it is not determined.
LEAST_KNOWN = 0.7
# Log Bayes factor from which a force outside is reported.  Noise alone reaches 1 in 100 frames.
MIN_LOG_EVIDENCE = 10.0
# Error of the mesh as a share of the displacement, which loads outside explain in part.
MODEL_ERROR_SHARE = 2e-3


class Plausibility:
    """Compares displacements and forces with limits that follow from one sensor's description.

    markers: the grid of the markers.
    """

    def __init__(self, sensor: SensorDescription, markers: SurfaceGrid) -> None:
        elastomer, pattern = sensor.elastomer, sensor.pattern
        thickness = elastomer.size[2]
        linear = elastomer.model == "linear"
        self._farthest = float(
            thickness * (MAX_LINEAR_DISPLACEMENT_RATIO if linear else MAX_DISPLACEMENT_RATIO)
        )
        self._shallow = float(thickness * MAX_SHALLOW_RATIO)
        self._pitch = float(pattern.pitch)
        self._rest = _rest(pattern, markers)
        area = float(np.prod(markers.extent))
        # Gent's stiffness of a bonded layer: pressed on all over, it gives way all through at this.
        wide = np.sqrt(area) / (4 * thickness)
        self._most_pressed = float(elastomer.young * (1 + 2 * wide**2) * area)
        self._most_pulled = float(
            min(TEARING_TENSION_RATIO * elastomer.young, AIR_PRESSURE_PA) * area
        )

    def allows_displacement(self, moved: Array) -> bool:
        """Whether a gel can move so: moved (rows, cols, 3) m, NaN where not known."""
        moved = plain(moved, np.float64)
        return bool(_keeps_order(moved, self._rest, self._farthest, self._shallow))

    def allows_force(self, force: Array, unexplained: Array) -> bool:
        """Whether a gel can bear forces (nodes, 3) N that leave so much of its motion open.

        unexplained (rows, cols, 3) m: displacement beyond what the forces explain, NaN where not
        known.
        """
        return bool(
            _can_bear(
                force,
                plain(unexplained, np.float64),
                (self._most_pulled, self._most_pressed),
                self._pitch,
            )
        )


@kernel
def _keeps_order(moved: Array, rest: Array, farthest: float, shallow: float) -> bool:
    """As Plausibility.allows_displacement; rest (rows, cols, 3) m."""
    # Of one view the depth is not known, nor is it needed here; but without the depth steep flanks
    # are not known either: only what changes places is refused.
    most = 1.0 if np.isnan(moved[..., 2]).all() else MAX_DISTANCE_CHANGE
    rows, cols = moved.shape[:2]
    for i in range(rows):
        for j in range(cols):
            here, depth = moved[i, j], _depth(moved[i, j])
            if here[0] ** 2 + here[1] ** 2 + depth**2 > farthest**2:
                return False
            for k, m in ((i + 1, j), (i, j + 1)):
                if k == rows or m == cols:
                    continue
                deep = _depth(moved[k, m])
                if abs(depth) > shallow or abs(deep) > shallow:
                    continue
                step = apart = 0.0
                for c in range(3):
                    change = deep - depth if c == 2 else moved[k, m, c] - here[c]
                    along = rest[k, m, c] - rest[i, j, c]
                    step += change * along
                    apart += along * along
                if abs(step) > most * apart:
                    return False
    return True


@kernel_part
def _depth(moved: Array) -> float:
    """How far a marker has moved along z, 0 where that is not known."""
    return 0.0 if math.isnan(moved[2]) else float(moved[2])


@kernel
def _can_bear(
    force: Array, unexplained: Array, most_normal: tuple[float, float], pitch: float
) -> bool:
    """As Plausibility.allows_force; most_normal N: that pulls and that presses."""
    # Of one view the forces are inferred: what is open about them is in their deviations.
    if np.isnan(unexplained[..., 2]).all():
        return True
    pulled = pressed = 0.0
    for n in range(len(force)):
        pulled += max(force[n, 2], 0.0)
        pressed += max(-force[n, 2], 0.0)
    return not (pulled > most_normal[0] or pressed > most_normal[1]) and _is_explained(
        unexplained, pitch
    )


@kernel_part
def _is_explained(unexplained: Array, pitch: float) -> bool:
    """Whether little is left of the displacement, of all together and between neighbours."""
    rows, cols = unexplained.shape[:2]
    total, count, most = 0.0, 0, MAX_RESIDUAL_STEP_PITCHES * pitch
    for i in range(rows):
        for j in range(cols):
            for c in range(3):
                left = unexplained[i, j, c]
                if math.isnan(left):
                    continue
                total += left * left
                count += 1
                if c < 2 and i + 1 < rows and abs(unexplained[i + 1, j, c] - left) > most:
                    return False
                if c < 2 and j + 1 < cols and abs(unexplained[i, j + 1, c] - left) > most:
                    return False
    return total <= (MAX_RESIDUAL_PITCHES * pitch) ** 2 * count


def _rest(pattern: Pattern, markers: SurfaceGrid) -> Array:
    """Markers at rest, (rows, cols, 3) m."""
    points = markers.points
    height = pattern.surface.height(points)
    return np.column_stack([points, height]).reshape(markers.rows, markers.cols, 3)


class _Explanations(NamedTuple):
    """What a frame's data are weighed with; d data free of rigid motions, m modes of loads outside.

    basis: from each parity's part of the data to its share of the d.  probe (l m, d): of variances
    (l,) of the forces inside.  shrink (l, d), volume (l,): of these.  gain (o, l, m),
    more_volume (o, l): of variances (o,) of the forces outside.
    """

    basis: tuple[NDArray[np.float32], ...]
    probe: NDArray[np.float32]
    shrink: Array
    volume: Array
    gain: Array
    more_volume: Array


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
        self._rows = (3 * self._used.reshape(-1, 1) + np.arange(3)).ravel()
        self._noise = np.tile(noise, self._used.size)
        folds = [parity.orthonormal(*self._used.shape) for parity in PARITIES]
        free = [fold.shape[1] - self._rigid(fold).shape[1] for fold in folds]
        total = sum(free)
        problem = _outside_problem(ElasticProblem.from_sensor(sensor), sensor.elastomer.size)
        outside = _is_outside(problem)
        self._modes = min(MODES, total // 4, 3 * int(outside.sum()))
        if not self._modes:
            return
        key = {"version": VERSION, "noise": noise, "problem": problem.key}
        names = [f"basis_{number}" for number in range(len(folds))]
        shapes: dict[str, tuple[int, ...]] = {
            "inside": (total,),
            "modes": (len(INSIDE_VARIANCES), self._modes, total),
            "outside": (len(INSIDE_VARIANCES), self._modes),
        }
        for name, rows, fold in zip(names, free, folds, strict=True):
            shapes[name] = rows, fold.shape[1]
        arrays = cached_arrays(
            cache_dir,
            "border_contact",
            key,
            shapes,
            lambda: self._build(problem, outside, dict(zip(names, folds, strict=True))),
        )
        # From displacements of all markers, m, to the parts of the data by parity.
        in_noise = sparse.csr_array(
            (1 / self._noise, (np.arange(len(self._rows)), self._rows)),
            shape=(len(self._rows), 3 * elastic.markers.rows * elastic.markers.cols),
        )
        self._fold = SparseRows(sparse.hstack(folds).T @ in_noise)
        inside = 1 + INSIDE_VARIANCES[:, None] * arrays["inside"]
        outside_part = OUTSIDE_VARIANCES[:, None, None] * arrays["outside"]
        # Rounded to 1e-7 of the displacement, a thousandth of the noise.
        self._explanations = _Explanations(
            tuple(arrays[name].astype(np.float32) for name in names),
            arrays["modes"].astype(np.float32).reshape(-1, total),
            1 / inside,
            np.log(inside).sum(axis=1),
            outside_part / (1 + outside_part),
            np.log1p(outside_part).sum(axis=2),
        )

    def reaches_beyond(self, displacement: Array, force: Array) -> bool:
        """Whether these displacements are those of a force outside, at least in part.

        displacement (rows, cols, 3) m, NaN where not known; force (nodes, 3) N as found inside,
        the displacement of which serves there.  False where so much is not known, as the depth of a
        sensor with one view, that it cannot be determined.
        """
        if not self._modes:
            return False
        folded = self._fold.of_vector(displacement.ravel())
        with one_thread():
            if not np.isfinite(folded).all():
                known = np.isfinite(displacement)
                if known.reshape(-1, 3)[self._used].mean() < LEAST_KNOWN:
                    return False
                predicted = self._elastic.displacement(force)
                folded = self._fold.of_vector(np.where(known, displacement, predicted).ravel())
            return bool(_is_outside_likelier(folded, self._explanations))

    def _build(
        self,
        problem: ElasticProblem,
        outside: NDArray[np.bool_],
        folds: Mapping[str, sparse.csc_array],
    ) -> dict[str, Any]:
        elastic = self._elastic
        rows = self._rows
        with one_thread():
            beyond = problem.expand(problem.solve())[rows][:, np.repeat(outside, 3)]
            beyond = _of_smooth(beyond / self._noise[:, None], problem.nodes, outside)
            within = elastic.compliance[rows] / self._noise[:, None]
            within = _of_smooth(within, elastic.nodes, np.ones(len(within.T) // 3, dtype=bool))
            bases, strength, moved = {}, [], []
            for name, fold in folds.items():
                rigid = self._rigid(fold)
                free = np.linalg.qr(rigid, mode="complete")[0][:, rigid.shape[1] :]
                part = free.T @ (fold.T @ within)
                values, vectors = eigh(part @ part.T, check_finite=False)
                bases[name] = vectors.T @ free.T
                strength.append(values)
                moved.append(bases[name] @ (fold.T @ beyond))
            inside = np.concatenate(strength)
            inside = np.maximum(inside / inside.max(), 0.0)
            response = np.concatenate(moved)
            modes = [
                _strongest(response, 1 + size * inside, self._modes) for size in INSIDE_VARIANCES
            ]
        of_modes = np.stack([part for _, part in modes])
        return {
            **bases,
            "inside": inside,
            "modes": np.stack([part for part, _ in modes]),
            "outside": of_modes / of_modes.max(),
        }

    def _rigid(self, fold: sparse.csc_array) -> Array:
        """What rigid motions leave of one parity's part of the data, (part, k).

        A camera that was knocked, or a reference of another day, is no force outside.
        """
        part = fold.T @ (_rigid_motions(self._elastic.markers)[self._rows] / self._noise[:, None])
        size = np.linalg.norm(part, axis=0)
        return np.asarray(part[:, size > LEAST_RIGID * np.linalg.norm(1 / self._noise)])


def _is_outside_likelier(folded: Array, weighed: _Explanations) -> bool:
    """Whether data, folded by parity, are likelier with loads outside than without."""
    parts = product_of_parts(weighed.basis, folded)
    of_modes = (weighed.probe @ parts.astype(np.float32)).astype(np.float64) ** 2
    squares = parts**2
    misfit = weighed.shrink @ squares
    explained = np.einsum("oim,im->oi", weighed.gain, of_modes.reshape(weighed.gain.shape[1:]))
    alone = _log_evidence(misfit, weighed.volume, len(parts)).max()
    volume = weighed.volume + weighed.more_volume
    both = _log_evidence(misfit - explained, volume, len(parts)).max()
    return bool(both - alone > MIN_LOG_EVIDENCE + 0.5 * MODEL_ERROR_SHARE**2 * squares.sum())


def _log_evidence(misfit: Array, volume: Array, count: int) -> Array:
    """Of data (count,) with these misfits, for the noise that is likeliest."""
    noise = np.maximum(misfit / count, MIN_NOISE_SQUARED)
    return np.asarray(-0.5 * (count * np.log(noise) + misfit / noise + volume))


def _of_smooth(response: Array, nodes: SurfaceGrid, some: NDArray[np.bool_]) -> Array:
    """Response (data, 3 k) to independent unknowns that make smooth forces on some nodes."""
    prior = smoothness(nodes, SMOOTHING_LENGTH)[np.ix_(some, some)]
    components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
    lower = np.linalg.cholesky(np.kron(prior, components))
    return np.asarray(solve_triangular(lower, response.T, lower=True, check_finite=False).T)


def _strongest(response: Array, variance: Array, count: int) -> tuple[Array, Array]:
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
    """Numbers (rows, cols) of the markers that are used: of a fine grid every second, or third.

    Those on one side mirror those on the other.
    """
    numbers = np.arange(markers.rows * markers.cols).reshape(markers.rows, markers.cols)
    lines = []
    for count in numbers.shape:
        half = np.arange(0, (count + 1) // 2, -(-count // MOST_MARKERS))
        lines.append(np.union1d(half, count - 1 - half))
    return numbers[np.ix_(*lines)]


def _rigid_motions(markers: SurfaceGrid) -> Array:
    """Displacements (3 markers, 6) of the markers by small rigid motions of all of them."""
    points = np.zeros((markers.rows * markers.cols, 3))
    points[:, :2] = markers.points
    along = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
    about = [np.cross(axis, points) / max(markers.extent) for axis in np.eye(3)]
    return np.stack([motion.ravel() for motion in (*along, *about)], axis=1)
