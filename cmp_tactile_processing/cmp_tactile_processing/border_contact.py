"""Tells whether a force outside the marker area moves the markers.

Force nodes lie over the markers only, so a load beyond them is told as forces at the border that
are not there.  What gives it away is what such forces leave over: each load outside moves the
markers in a way of its own, of which the nodes inside can imitate the coarse part only.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh, svd

from cmp_tactile_processing.blas_threads import one_blas_thread
from cmp_tactile_processing.disk_cache import cached_arrays
from cmp_tactile_processing.elastic_model import ElasticModel
from cmp_tactile_processing.elastic_problem import ElasticProblem
from cmp_tactile_processing.elastomer_mesh import MeshDensity
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.surface_grid import SurfaceGrid
from cmp_tactile_processing.traction_prior import TANGENTIAL_SHARE, smoothness

__all__ = ["BorderContact"]

# To be raised with every change that alters the arrays of the same sensor.
VERSION = 2
# What a load outside does fades over the thickness of the gel: a quarter of it resolves that.
SPACING_PER_THICKNESS = 0.25
# No more across a thin gel, by far: what is farther outside than the gel is thick does not matter.
MOST_CELLS = 32
# Coarser than that of the force nodes: only the shape of what loads outside do counts.
DENSITY = MeshDensity(across=16, rim=2, depth=3)
# What the nodes inside may imitate: all but the finest of what they can do.  Weight relative to the
# largest eigenvalue, as in TractionSpectrum, and length, m.
WEIGHT, SMOOTHING_LENGTH = 1e-7, 1.5e-3
# Along each side; more would tell the same.
MOST_MARKERS = 20
# Ways in which loads outside move the markers that count; later ones are a tenth as strong.
MODES = 40
# Noise alone has this energy in so many modes once in ten thousand frames, over their number.
SIGNIFICANT = 2.0
# Share of the displacements without which it is not told.
LEAST_KNOWN = 0.7
# Share of the energy left over that loads outside explain; loads inside, told too coarsely, leave
# less.
EXPLAINED = 0.45


class BorderContact:
    """Judges displacements of one sensor's markers; what it needs is kept on disk.

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
        problem = _outside_problem(ElasticProblem.of(sensor), sensor.elastomer.size)
        self._outside = _is_outside(problem)
        self._modes = min(MODES, 3 * count // 4, 3 * int(self._outside.sum()))
        if not self._modes:
            return
        key = {"version": VERSION, "noise": noise, "problem": problem.key}
        shapes = {"rest": (3 * count, 3 * count), "modes": (self._modes, 3 * count)}
        arrays = cached_arrays(
            cache_dir, "border_contact", key, shapes, lambda: self._build(problem)
        )
        self._rest = arrays["rest"]
        # Modes lie in what is left over, so they may be applied to what is measured.
        self._probe = np.ascontiguousarray(arrays["modes"])
        self._freedom = float((self._rest**2).sum())

    def reaches_beyond(self, displacement: NDArray[np.float64], force: NDArray[np.float64]) -> bool:
        """Whether these displacements are those of a force outside, at least in part.

        displacement (rows, cols, 3) m, NaN where not known; force (nodes, 3) N as found inside,
        whose displacement serves there.  False where so much is not known, as the depth of a
        sensor with one view, that it cannot be told.
        """
        moved = displacement.reshape(-1, 3)[self._used]
        known = np.isfinite(moved)
        if not self._modes or known.mean() < LEAST_KNOWN:
            return False
        if not known.all():
            with one_blas_thread():
                predicted = self._elastic.displacement(force).reshape(-1, 3)[self._used]
            moved = np.where(known, moved, predicted)
        moved = moved.ravel() / self._noise
        # einsum, as it leaves the other cores alone.
        energy = float((np.einsum("ij,j->i", self._probe, moved) ** 2).sum())
        if not energy > SIGNIFICANT * self._modes:
            return False
        total = float((np.einsum("ij,j->i", self._rest, moved) ** 2).sum())
        # Of the noise that the parameters tell: what the frame shows of it, a force outside raises.
        noise = self._freedom * float(known.mean())
        return energy - self._modes > EXPLAINED * (total - noise)

    def _build(self, problem: ElasticProblem) -> dict[str, Any]:
        elastic = self._elastic
        rows = (3 * self._used[:, None] + np.arange(3)).ravel()
        with one_blas_thread():
            outside = problem.expand(problem.solve())[rows] / self._noise[:, None]
            columns = np.repeat(self._outside, 3)
            rest = _left_over(elastic.compliance[rows] / self._noise[:, None], elastic.nodes)
            # A camera that was knocked, or a reference of another day, is no force outside.
            rigid = _rigid_motions(elastic.markers)[rows] / self._noise[:, None]
            known, _ = np.linalg.qr(rest @ rigid)
            rest -= known @ (known.T @ rest)
            modes, _, _ = svd(rest @ outside[:, columns], full_matrices=False)
        return {"rest": rest, "modes": modes[:, : self._modes].T @ rest}


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
    """Numbers of the markers that are judged: of a fine grid every second, or third."""
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


def _left_over(weighted: NDArray[np.float64], nodes: SurfaceGrid) -> NDArray[np.float64]:
    """Matrix from whitened displacements to what the forces inside that fit best leave over."""
    components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
    prior = np.kron(smoothness(nodes, SMOOTHING_LENGTH), components)
    size = len(prior) - 1
    largest = eigh(weighted.T @ weighted, prior, eigvals_only=True, subset_by_index=(size, size))[0]
    factor = cho_factor(weighted.T @ weighted + WEIGHT * largest * prior, check_finite=False)
    fitted = weighted @ cho_solve(factor, weighted.T, check_finite=False)
    return np.asarray(np.eye(len(weighted)) - fitted)
