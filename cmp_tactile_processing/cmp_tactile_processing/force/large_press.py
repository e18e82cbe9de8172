"""What large strain adds to the linear model of the gel: the displacement of a neo-Hookean one.

The force that a linear inverse finds is put on a neo-Hookean gel and on a linear one of the same
mesh; by how much their markers move differently is taken off the measured displacement, and the
inverse does the rest (`settle`).  Only the difference counts, so that a coarse mesh will do.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.arrays import cached_arrays
from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.cholesky import RestInverse
from cmp_tactile_processing.elastic.equilibrium import QuickEquilibrium
from cmp_tactile_processing.elastic.mesh import MeshDensity, hat_loads, interpolation
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, mirrored_response
from cmp_tactile_processing.elastic.model import ElasticProblem, quarter_count
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.errors import InputError, NotConvergedError
from cmp_tactile_processing.processes import OnProgress

LOGGER = logging.getLogger(__name__)

Array = NDArray[np.float64]

# To be raised with every change that alters the arrays in the cache for the same problem.
CACHE_VERSION = 2

# On this mesh the force of spheres of 4 and 8 mm pressed up to 1 mm into 6 mm of gel comes out
# within 0.9 %, without noise; two more elements across make that 0.3 % at twice the time.
DENSITY = MeshDensity(across=6, rim=1, depth=2, growth=2.0)

# What is taken off stands when it differs by less than this share of a marker's noise and of the
# displacement (root mean squares) from what the solution found with it adds.
NOISE_SHARE, SHARE = 0.1, 1.5e-3
MAX_ROUNDS = 10
# Accuracy that is asked of the excess: the tolerance in the end and in the first round of a warm
# start, a share of the displacement in the first round of others and of the last round's change
# later on, where more would be wasted.
FIRST_ACCURACY, ACCURACY = 0.02, 0.15
# Earlier rounds from which the next is extrapolated.
DEPTH = 2


class LargePress:
    """The neo-Hookean gel of an elastic problem, followed from one force field to the next.

    young: of the body, Pa.  cache_dir: folder of the disk cache; default as in ElasticModel.
    progress: called with a text and the fraction done while the inverse stiffness is built,
    about a second.  density: how fine the block is cut.

    Loads are dead: forces keep direction and size while the surface moves.  A pressure of some
    two shear moduli makes a soft surface fold; nothing is found beyond.
    """

    def __init__(
        self,
        problem: ElasticProblem,
        young: float,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
        density: MeshDensity = DENSITY,
    ) -> None:
        if problem.geometry.layer == 0:
            density = replace(density, depth=density.depth + 1)
        self._problem = problem = replace(problem, density=density)
        self._young = young
        at_rest = RestInverse(problem.mesh())
        of_markers, of_nodes = quarter_count(problem.markers), quarter_count(problem.nodes)
        arrays = cached_arrays(
            cache_dir,
            "large_press",
            {"large_press": CACHE_VERSION, **problem.key},
            {
                "inverse": (at_rest.size,),
                "response": (len(PARITIES), 3 * of_markers, 3 * of_nodes),
            },
            lambda: _build(problem, at_rest, progress),
        )
        self._response = arrays["response"]
        self._mesh = mesh = problem.mesh().mirrored()
        at_rest.use(arrays["inverse"])
        elements = NeoHookeanElements.from_mesh(
            mesh, problem.poisson, layer_young=problem.layer_ratio
        )
        self._block = QuickEquilibrium(mesh, elements, at_rest)
        nodes, markers = problem.nodes, problem.markers
        self._hats = hat_loads(mesh.x_edges, nodes.x), hat_loads(mesh.y_edges, nodes.y)
        self._at_nodes = interpolation(mesh.x_edges, nodes.x), interpolation(mesh.y_edges, nodes.y)
        self._at_markers = (
            interpolation(mesh.x_edges, markers.x),
            interpolation(mesh.y_edges, markers.y),
        )
        self.reset()

    def reset(self) -> None:
        """Forget the last force: the next one is sought from rest."""
        self._block.reset()
        self._latest = np.zeros((self._problem.markers.rows, self._problem.markers.cols, 3))

    @property
    def latest(self) -> Array:
        """The excess found last, (rows, cols, 3) m; zeros after a reset or an error."""
        return self._latest

    @property
    def steps(self) -> int:
        """How many steps the last force has taken."""
        return self._block.steps

    @property
    def moved(self) -> Array:
        """Displacement of the contact surface at the force nodes under the last force, (M, 3) m."""
        return self._seen(self._at_nodes, self._mesh.lattice[2] - 1).reshape(-1, 3)

    def excess(self, force: Array, accuracy: float = 0.0) -> Array:
        """By how much more than linearly the markers move under nodal forces (M, 3) N.

        (rows, cols, 3) m, of second order in the force.  The equilibrium is sought from the last
        one on, until steps move the markers by less than `accuracy`, m (root mean square), or 5e-4
        of their displacement.  Raises NotConvergedError where there is none within reach; the
        next one is then sought from rest.  Raises InputError for an array of another shape.
        """
        nodes = self._problem.nodes
        if np.shape(force) != (nodes.rows * nodes.cols, 3):
            expected = nodes.rows * nodes.cols, 3
            msg = f"force: found shape {np.shape(force)}, expected {expected}"
            raise InputError(msg)
        unit = np.asarray(force, dtype=np.float64) / self._young
        with one_thread():
            if not (np.isfinite(unit).all() and self._block.move_to(self._load(unit), accuracy)):
                self.reset()
                raise NotConvergedError(_complaint(force))
            seen = self._seen(self._at_markers, self._mesh.marker_level)
            self._latest = seen - self._linear(unit)
        return self._latest

    def _linear(self, unit: Array) -> Array:
        """Displacement of the markers of the linear gel, (rows, cols, 3) m."""
        nodes, markers = self._problem.nodes, self._problem.markers
        moved = mirrored_response(self._response, nodes, markers, unit.ravel())
        return moved.reshape(markers.rows, markers.cols, 3)

    def _load(self, unit: Array) -> Array:
        """Nodal forces of the mesh (lattice nodes, 3), spread over its top as hats."""
        x, y = self._hats
        nodes = self._problem.nodes
        load = np.zeros((*self._mesh.lattice, 3))
        spread = np.tensordot(y, unit.reshape(nodes.rows, nodes.cols, 3), axes=(1, 0))
        load[:, :, -1] = np.tensordot(x, spread, axes=(1, 1))
        return load.reshape(-1, 3)

    def _seen(self, lines: tuple[Array, Array], level: int) -> Array:
        """Displacement at one level of the mesh, on a grid (rows, cols, 3) m."""
        x, y = lines
        moved = self._block.displacement.reshape(*self._mesh.lattice, 3)[:, :, level]
        return np.tensordot(y, np.tensordot(x, moved, axes=(1, 0)), axes=(1, 1))


def _complaint(force: Array) -> str:
    total = ", ".join(f"{part:.4g}" for part in np.sum(force, axis=0))
    greatest = float(np.max(np.linalg.norm(force, axis=1)))
    return (
        f"the neo-Hookean gel has no solution for the force ({total}) N, with up to "
        f"{greatest:.3g} N on a node"
    )


def _build(
    problem: ElasticProblem, at_rest: RestInverse, progress: OnProgress | None
) -> dict[str, Array]:
    start = monotonic()
    inverse = at_rest.build(problem.poisson, problem.layer_ratio)
    response = np.stack(problem.solve(progress=progress))
    LOGGER.info("built the model for large presses in %.1f s", monotonic() - start)
    return {"inverse": inverse, "response": response}


def settle(
    solve: Callable[[Array], Array],
    excess: Callable[[Array, float], Array],
    displacement: Array,
    start: Array | None = None,
    noise: float = 2e-6,
) -> tuple[Array, bool]:
    """Solution f of f = solve(displacement - excess(f)), and whether it stands.

    excess(f, accuracy): to that accuracy, m, as LargePress.excess.  displacement (rows, cols, 3)
    m may hold NaN, which `solve` is given as it is.  start: excess to begin with, of the last
    frame for example; none by default.  noise: standard deviation of a marker's displacement, m.
    Raises what `solve` and `excess` raise.

    Rounds are extrapolated (Anderson acceleration, Walker and Ni 2011).
    """
    warm = start is not None and bool(np.any(start))
    added = np.array(start, dtype=np.float64) if warm else np.zeros(displacement.shape)
    known = np.isfinite(displacement)
    moved = _size(displacement[known]) if known.any() else 0.0
    tolerance = max(NOISE_SHARE * noise, SHARE * moved)
    accuracy = tolerance if warm else max(tolerance, FIRST_ACCURACY * moved)
    found: list[tuple[Array, Array]] = []
    solution = solve(displacement - added)
    for _ in range(MAX_ROUNDS):
        result = excess(solution, accuracy)
        change = result - added
        if _size(change) <= tolerance and accuracy <= tolerance:
            return solution, True
        accuracy = max(tolerance, min(accuracy, ACCURACY * _size(change)))
        found = [*found, (result, change)][-DEPTH - 1 :]
        added = _extrapolated(found)
        solution = solve(displacement - added)
    return solution, False


def _extrapolated(found: list[tuple[Array, Array]]) -> Array:
    """The mixture of the latest results whose change is least."""
    result, change = found[-1]
    if len(found) == 1:
        return result
    results = np.stack([(result - earlier).ravel() for earlier, _ in found[:-1]], axis=1)
    changes = np.stack([(change - earlier).ravel() for _, earlier in found[:-1]], axis=1)
    shares = np.linalg.lstsq(changes.T @ changes, changes.T @ change.ravel(), rcond=1e-6)[0]
    return np.asarray(result - (results @ shares).reshape(result.shape))


def _size(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
