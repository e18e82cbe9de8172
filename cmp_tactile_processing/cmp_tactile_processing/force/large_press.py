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
from cmp_tactile_processing.elastic.equilibrium import (
    WITHOUT_END,
    NoEquilibriumError,
    QuickEquilibrium,
)
from cmp_tactile_processing.elastic.mesh import MeshDensity, hat_loads, interpolation
from cmp_tactile_processing.elastic.mirror_symmetry import PARITIES, mirrored_response
from cmp_tactile_processing.elastic.model import ElasticProblem, Progress, quarter_count
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.errors import GeometryError

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

# The share of the displacement by which a press moves on from the force that is on the way to
# equilibrium, and that by which it is another one.
JUMP_SHARE, NEW_SHARE = 0.05, 0.7
# Steps that take as long as a solution.
SOLUTION_STEPS = 2


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
        progress: Progress | None = None,
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
        # Compiled, or read from numba's cache, before the first frame.
        self.excess(np.full((nodes.rows * nodes.cols, 3), 1e-9 * young))
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

        (rows, cols, 3) m, of second order in the force.  See `approach`.
        """
        self.approach(force, accuracy)
        return self._latest

    def approach(self, force: Array, accuracy: float = 0.0, most: int = WITHOUT_END) -> bool:
        """Seek the excess of nodal forces (M, 3) N in at most so many steps; whether it is found.

        The equilibrium is sought from the last one on, until steps move the markers by less than
        `accuracy`, m (root mean square), or 5e-4 of their displacement.  Where the steps do not
        suffice, `latest` stays and the next call goes on from there.  Raises NoEquilibriumError
        where there is none within reach; the next one is then sought from rest.  Raises
        GeometryError for an array of another shape.
        """
        nodes = self._problem.nodes
        if np.shape(force) != (nodes.rows * nodes.cols, 3):
            expected = nodes.rows * nodes.cols, 3
            msg = f"force: found shape {np.shape(force)}, expected {expected}"
            raise GeometryError(msg)
        unit = np.asarray(force, dtype=np.float64) / self._young
        with one_thread():
            finite = np.isfinite(unit).all()
            found = self._block.move_to(self._load(unit), accuracy, most) if finite else False
            if found is False:
                self.reset()
                raise NoEquilibriumError(_complaint(force))
            if found:
                seen = self._seen(self._at_markers, self._mesh.marker_level)
                self._latest = seen - self.linear(force)
        return bool(found)

    def linear(self, force: Array) -> Array:
        """Displacement of the markers of the linear gel, (rows, cols, 3) m."""
        nodes, markers = self._problem.nodes, self._problem.markers
        unit = np.asarray(force, dtype=np.float64) / self._young
        moved = mirrored_response(self._response, nodes, markers, unit.ravel())
        return moved.reshape(markers.rows, markers.cols, 3)

    def turn_to_another(self) -> None:
        """What comes next is another force, not the one on the way to which the steps ended."""
        self._block.start_again()

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
    problem: ElasticProblem, at_rest: RestInverse, progress: Progress | None
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
    moved = _size_of_known(displacement)
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


class GradualSettling:
    """`settle` over several frames, with a bounded number of steps in each.

    A force is brought to equilibrium, in one frame or several; with the excess that it turns out to
    have the next one is solved for, until that changes no more.
    large: the gel.  steps: towards the equilibrium in a frame, SOLUTION_STEPS less where it is
    solved for a force, too.  taken_off (rows, cols, 3) m: of the displacement in the last solution.
    """

    def __init__(self, large: LargePress, steps: int) -> None:
        self._large, self._most = large, steps
        self.reset()

    def reset(self) -> None:
        """Forget the frames before; the gel is at rest."""
        self._large.reset()
        self._added = self.taken_off = self._large.latest
        self._at = self._linear_at = np.zeros_like(self._added)
        self._open, self._stands, self._accuracy = np.inf, False, 0.0
        self._target, self._on_the_way = self._at, False
        self._found: list[tuple[Array, Array]] = []

    def follow(
        self, solve: Callable[[Array], Array], displacement: Array, noise: float, worth: float
    ) -> float:
        """What is open of the latest of `solve`, root mean square, as a share of the displacement.

        0 where it stands as in `settle`; infinite where it is known to be open by more than
        `worth`.  Other arguments and errors: see `settle`.
        """
        moved = _size_of_known(displacement)
        tolerance = max(NOISE_SHARE * noise, SHARE * moved)
        self._look_for_jumps(displacement, moved)
        self._accuracy = max(self._accuracy, tolerance)
        left, most, fresh = np.inf, self._most, not self._on_the_way
        if fresh or self._open < worth * moved:
            self.taken_off = self._added
            solution = solve(displacement - self.taken_off)
            linear = self._large.linear(solution)
            ahead = self._ahead(linear, tolerance)
            if self._stands and ahead <= tolerance:
                return 0.0
            left, most = self._open + ahead, max(1, most - SOLUTION_STEPS)
            if fresh:
                self._target, self._target_linear, self._at = solution, linear, displacement
                self._on_the_way = True
        try:
            found = self._large.approach(self._target, self._accuracy, most)
        except NoEquilibriumError:
            self.reset()
            raise
        if found:
            self._take(tolerance)
            if fresh:
                left = 0.0 if self._stands else self._open
        return left / moved if left <= worth * moved else np.inf

    def _ahead(self, linear: Array, tolerance: float) -> float:
        """By how much the excess will change to that of a force of this linear displacement, m.

        It grows as the square of the displacement.
        """
        rate = 2 * _size(self._large.latest) / max(_size(self._linear_at), tolerance)
        return rate * _size(linear - self._linear_at)

    def _take(self, tolerance: float) -> None:
        """Add from now on what the force added that has come to equilibrium."""
        result = self._large.latest
        change = result - self._added
        self._open = _size(change)
        self._stands = max(self._open, self._accuracy) <= tolerance
        self._accuracy = max(tolerance, min(self._accuracy, ACCURACY * self._open))
        self._found = [*self._found, (result, change)][-DEPTH - 1 :]
        self._added = result if self._stands else _extrapolated(self._found)
        self._on_the_way, self._linear_at = False, self._target_linear

    def _look_for_jumps(self, displacement: Array, moved: float) -> None:
        """Leave the force on the way where the gel has moved on since."""
        step = _size_of_known(displacement - self._at)
        if step > NEW_SHARE * moved:
            self.reset()
        elif step > JUMP_SHARE * moved:
            self._on_the_way, self._found = False, []
            self._large.turn_to_another()
        self._accuracy = max(self._accuracy, FIRST_ACCURACY * min(step, moved))


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


def _size_of_known(values: Array) -> float:
    known = np.isfinite(values)
    return _size(values[known]) if known.any() else 0.0
