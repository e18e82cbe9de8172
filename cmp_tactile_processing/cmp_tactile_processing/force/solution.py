"""Two-pass reconstruction of the nodal forces from displacements in units of their noise.

The first pass shows which nodes may bear a traction (`ContactRule`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.kernels import kernel, kernel_part, plain
from cmp_tactile_processing.elastic.mirror_symmetry import SparseRows
from cmp_tactile_processing.force.contact_regions import resultant_matrix
from cmp_tactile_processing.force.contact_traction import (
    ContactTraction,
    SeenData,
    TractionPosterior,
)
from cmp_tactile_processing.force.traction_spectrum import (
    FirstPass,
    TractionScale,
    TractionSpectrum,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parameters import ForceParameters

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A force in any direction has three components to stand out of the noise with, and the first pass
# rings by up to 4.5 deviations around a load; a press has one.
ANY_DIRECTION = 5 / 3

Grid = TypeVar("Grid", NDArray[np.float64], NDArray[np.bool_])

# Steps from the scale of the first pass to the contact's own; mostly none or one is needed.
MAX_SCALE_STEPS = 3
# That of a wide contact is nearly the first pass's.
WIDE_SCALE_STEPS = 1
# The hats leave a node's own force open: its standard deviation along z as a share of the largest
# force around the node, from contacts solved on finer nodes, and factors of that along x, y, z.
NODE_STD_SHARE = 0.02
NODE_STD_BY_AXIS = (0.5, 0.5, 1.0)
# Weight of the first pass that the deviations of a wrench at rest hold for.
REST_WEIGHT = 1e-6
# The second pass lacks nodes if it leaves more than this many times the first pass's squared
# misfit; else the ratio is mostly below 1.1.
MAX_SECOND_PASS_RATIO = 1.2
# Markers that no force has moved, as those of another reference, are explained by weak loads on the
# whole surface; so is a gel that does not quite follow the model.  So nodes are added only if
# - at most this share of the nodes is then loaded,
MAX_LOADED_SHARE = 0.5
# - the squared misfit is then at most this many times that of the first pass.
MAX_MISFIT_RATIO = 2.0


class ContactRule:
    """Compares nodal forces with the noise, with their peak and with a floor.

    The peak is the largest component in any direction, as what rings around a pull or a drag is
    no contact.  area: of one node, seen along z, m^2, by which a nodal force along z is the normal
    pressure on a sloping surface, too.
    """

    def __init__(self, parameters: ForceParameters, shape: tuple[int, int], area: float) -> None:
        self._shape = shape
        floor = float(parameters.contact_pressure_floor * area)
        share, deviations = parameters.contact_threshold, parameters.contact_deviations
        self._limits = float(share), floor, float(deviations)

    def pressed(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) in contact: force (n, 3) N on the gel, normal_std (n,) N of its z."""
        return _bearing(force, plain(normal_std, np.float64), self._limits, self._shape)[0]

    def loaded(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that may bear a force: those pressed, pulled or dragged, and around them.

        force (n, 3) N on the gel, normal_std (n,) N of its z.
        """
        return _widened(self.bearing(force, normal_std), self._shape)

    def bearing(self, force: Array, normal_std: Array) -> Mask:
        """Nodes (n,) that are pressed, pulled or dragged, from the same arrays.

        Pulls and drags that reach opposite sides of the grid count as none: markers that have
        moved by no force, as from a reference of another day or in a row that is numbered wrongly,
        are explained by such.
        """
        return _bearing(force, plain(normal_std, np.float64), self._limits, self._shape)[1]

    def spans(self, nodes: Mask) -> bool:
        """Whether nodes (n,) reach opposite sides of the grid."""
        return _spans(nodes.reshape(self._shape))

    def edge(self, nodes: Mask) -> Mask:
        """Those of some nodes (n,) that have a neighbour on the grid which is none of them."""
        return np.asarray(nodes & _widened(~nodes, self._shape))


@kernel
def _bearing(
    force: Array, normal_std: Array, limits: tuple[float, float, float], shape: tuple[int, int]
) -> tuple[Mask, Mask]:
    """Nodes (n,) that are pressed, and those that bear anything, as the methods of ContactRule.

    limits: share of the peak, floor in N, and deviations.
    """
    share, floor, deviations = limits
    least, count = floor, len(force)
    for n in range(count):
        for c in range(3):
            least = max(least, share * abs(force[n, c]))
    pressed, others = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for n in range(count):
        noise = deviations * normal_std[n]
        pressed[n] = -force[n, 2] > max(least, noise)
        size = np.sqrt(force[n, 0] ** 2 + force[n, 1] ** 2 + force[n, 2] ** 2)
        others[n] = not pressed[n] and size > max(least, ANY_DIRECTION * noise)
    if _spans(others.reshape(shape)):
        return pressed, pressed.copy()
    return pressed, pressed | others


@kernel_part
def _spans(grid: Mask) -> bool:
    """As ContactRule.spans; grid (rows, cols)."""
    between_rows = bool(grid[0].any() and grid[-1].any())
    return between_rows or bool(grid[:, 0].any() and grid[:, -1].any())


@kernel
def _widened(nodes: Mask, shape: tuple[int, int]) -> Mask:
    """With the four neighbours of each: what the resolution cuts off at a contact's edge."""
    rows, cols = shape
    found: Mask = nodes.copy()
    for n in range(len(nodes)):
        if nodes[n]:
            i, j = n // cols, n % cols
            found[n - cols if i > 0 else n] = True
            found[n + cols if i + 1 < rows else n] = True
            found[n - 1 if j > 0 else n] = True
            found[n + 1 if j + 1 < cols else n] = True
    return found


@dataclass(frozen=True)
class ForceSolution:
    """Nodal forces and what they explain.

    force (nodes, 3) N: consistent nodal forces, 0 outside the mask.  force_std (nodes, 3) N.
    coefficient (nodes, 3) N: of the hats.
    predicted (markers, 3): displacement in units of its noise.  loaded: whether there is any
    force that is not noise.  posterior: of the second pass, None without one.
    noise_squared: of the data over what the parameters say.
    """

    force: Array
    force_std: Array
    coefficient: Array
    predicted: Array
    loaded: bool
    first: FirstPass
    posterior: TractionPosterior | None
    noise_squared: float


class ForceSolver:
    """Inverts one response.

    response (3 markers, 3 nodes): displacement in units of its noise, per N.
    A solution follows from its data alone.
    """

    def __init__(
        self,
        markers: SurfaceGrid,
        nodes: SurfaceGrid,
        response: Array,
        parameters: ForceParameters,
    ) -> None:
        self._parameters = parameters
        self._shape = nodes.rows, nodes.cols
        self.rule = ContactRule(parameters, self._shape, nodes.spacing[0] * nodes.spacing[1])
        one = smoothness(nodes, parameters.smoothing_length)
        lumped = nodal_force_matrix(nodes)
        self._lumped, self._spread = (
            SparseRows(sparse.csr_array(matrix)) for matrix in (lumped, lumped.T)
        )
        self._spectrum = TractionSpectrum(markers, nodes, response, one, lumped)
        self._second = ContactTraction(self._spectrum, response, one)

    def solve(self, data: Array, known: Mask) -> ForceSolution:
        """Forces from data (3 markers,), in units of the noise, of which the `known` count."""
        weight = self._parameters.regularization**2 or None
        first = self._spectrum.solve(data, known, weight)
        force = self._collected(first.coefficient)
        if first.evidence < self._parameters.contact_evidence:
            return self._nothing(first)
        if not self._parameters.two_pass:
            return self._first_alone(first, force)
        mask = self.rule.loaded(force, first.nodal_std)
        if not mask.any():
            return self._nothing(first)
        seen = self._second.seen(data, known)
        posterior = self._on(mask, first, seen)
        posterior = self._with_weak_loads(first, posterior, seen)
        return self._second_pass(first, self._with_its_scale(posterior, seen))

    def again(self, before: ForceSolution, data: Array, known: Mask) -> ForceSolution:
        """Coefficients for data that are nearly those of an earlier solution, with its mask.

        All else of it stays; `completed` brings it up to date.
        """
        if before.posterior is None:
            return self.solve(data, known)
        posterior = self._second.again(before.posterior, self._second.seen(data, known))
        return replace(before, coefficient=self._on_all_nodes(posterior), posterior=posterior)

    def completed(self, solution: ForceSolution) -> ForceSolution:
        """Forces, deviations and prediction of what `again` gave."""
        if solution.posterior is None:
            return solution
        return self._second_pass(solution.first, solution.posterior)

    def functionals(
        self, place: Array, sets: list[NDArray[np.intp]], nodes: NDArray[np.intp]
    ) -> Array:
        """Functionals (6 s, 3 k) of the mask's coefficients that give wrenches about the origin.

        Of each of s sets of nodes, at place (nodes, 3) m.  nodes (k,): those of the mask.
        """
        weights = np.zeros((len(place), len(sets), 4))
        for number, some in enumerate(sets):
            weights[some, number, :3], weights[some, number, 3] = place[some], 1.0
        of_hats = self._spread.of_columns(weights.reshape(len(place), -1))
        return resultant_matrix(of_hats[nodes].reshape(len(nodes), len(sets), 4))

    def rest_covariance(self, functionals: Array) -> Array:
        """Covariance of functionals (j, 3 nodes) of nodal forces that noise of 1 alone causes."""
        by_node = functionals.reshape(len(functionals), -1, 3).transpose(1, 0, 2)
        of_hats = self._spread.of_columns(by_node.reshape(len(by_node), -1))
        of_hats = of_hats.reshape(by_node.shape).transpose(1, 0, 2).reshape(functionals.shape)
        return self._spectrum.noise_covariance(of_hats, REST_WEIGHT)

    def _collected(self, coefficient: Array) -> Array:
        """Consistent nodal forces (nodes, 3) of coefficients."""
        return self._lumped.of_columns(coefficient.reshape(-1, 3))

    def _on(self, mask: Mask, first: FirstPass, seen: SeenData) -> TractionPosterior:
        """The posterior on some nodes (n,), for the noise that the first pass shows."""
        edge, scale = self.rule.edge(mask), self._spectrum.scale_of_first(first)
        nodes = np.concatenate([np.flatnonzero(mask & ~edge), np.flatnonzero(edge)])
        # That is of a traction on the whole surface.
        dense = float(np.sqrt(mask.size / len(nodes)))
        scale = TractionScale(dense * scale.normal, dense * scale.tangential)
        weights = self._second.weights(scale, first.noise_squared)
        posterior = self._second.solve(seen, nodes, weights)
        return replace(posterior, edge=int(np.count_nonzero(edge)))

    def _with_its_scale(self, posterior: TractionPosterior, seen: SeenData) -> TractionPosterior:
        """The posterior for the sizes and the noise that it shows itself."""
        wide = self._second.is_wide(posterior.nodes)
        for _ in range(WIDE_SCALE_STEPS if wide else MAX_SCALE_STEPS):
            weights = self._second.likelier(posterior, seen)
            if weights == posterior.weights:
                break
            found = self._second.solve(seen, posterior.nodes, weights)
            posterior = replace(found, edge=posterior.edge)
        return posterior

    def _with_weak_loads(
        self, first: FirstPass, posterior: TractionPosterior, seen: SeenData
    ) -> TractionPosterior:
        """The posterior on a mask that holds weak loads beside a strong one, too.

        They are below a share of its peak, as is what rings around it.  What the second pass
        leaves over does not ring, and shows them.
        """
        if posterior.noise_squared <= MAX_SECOND_PASS_RATIO * first.noise_squared:
            return posterior
        mask = self._with_more(posterior, seen)
        if mask is None:
            return posterior
        wider = self._on(mask, first, seen)
        explained = wider.noise_squared <= MAX_MISFIT_RATIO * first.noise_squared
        return wider if explained else posterior

    def _with_more(self, posterior: TractionPosterior, seen: SeenData) -> Mask | None:
        """Nodes (n,) of the posterior and those that what it leaves asks for; None for none."""
        if self._is_all_over(len(posterior.nodes)):
            return None
        predicted = self._spectrum.respond(self._on_all_nodes(posterior).ravel())
        left = self._spectrum.solve(seen.data - predicted, seen.known)
        if left.evidence < self._parameters.contact_evidence:
            return None
        force = self._collected(left.coefficient)
        before = np.zeros(len(force), dtype=bool)
        before[posterior.nodes] = True
        mask = before | self.rule.loaded(force, left.nodal_std)
        strange = self.rule.spans(mask) and not self.rule.spans(before)
        strange = strange or self._is_all_over(int(np.count_nonzero(mask)))
        return None if strange or (mask == before).all() else mask

    def _is_all_over(self, nodes: int) -> bool:
        return nodes > MAX_LOADED_SHARE * self._shape[0] * self._shape[1]

    def _nothing(self, first: FirstPass) -> ForceSolution:
        nodes = self._shape[0] * self._shape[1]
        std = np.repeat(first.nodal_std[:, None], 3, axis=1)
        markers = len(first.data) // 3
        nothing = np.zeros((nodes, 3))
        return ForceSolution(
            nothing, std, nothing, np.zeros((markers, 3)), False, first, None, first.noise_squared
        )

    def _first_alone(self, first: FirstPass, force: Array) -> ForceSolution:
        std = np.repeat(first.nodal_std[:, None], 3, axis=1)
        predicted = self._spectrum.respond(first.coefficient).reshape(-1, 3)
        coefficient = first.coefficient.reshape(-1, 3)
        return ForceSolution(
            force, std, coefficient, predicted, True, first, None, first.noise_squared
        )

    def _on_all_nodes(self, posterior: TractionPosterior) -> Array:
        coefficient = np.zeros((self._shape[0] * self._shape[1], 3))
        coefficient[posterior.nodes] = posterior.coefficient.reshape(-1, 3)
        return coefficient

    def _second_pass(self, first: FirstPass, posterior: TractionPosterior) -> ForceSolution:
        coefficient = self._on_all_nodes(posterior)
        force = self._collected(coefficient)
        return ForceSolution(
            force,
            self._deviations(force, posterior, first),
            coefficient,
            self._spectrum.respond(coefficient.ravel()).reshape(-1, 3),
            True,
            first,
            posterior,
            posterior.noise_squared,
        )

    def _deviations(self, force: Array, posterior: TractionPosterior, first: FirstPass) -> Array:
        """Deviations (nodes, 3) N of nodal forces (nodes, 3).

        To what noise and resolution leave open comes what hats cannot show of the forces around.
        Where the mask bears nothing a force may hide in the noise.
        """
        variance = self._second.nodal_variance(posterior.weights)
        noise, alone = posterior.noise_squared, first.nodal_std
        return _deviations(force, posterior.nodes, variance, noise, alone, self._shape)


@kernel
def _deviations(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    force: Array,
    bearing: NDArray[np.intp],
    variance: Array,
    noise_squared: float,
    alone: Array,
    shape: tuple[int, int],
) -> Array:
    """As ForceSolver._deviations.

    bearing (k,): numbers of the mask's nodes.  variance (nodes, 3): for noise of 1, at them and
    beside them.  alone (nodes,) N: deviation elsewhere.
    """
    near, around = np.zeros(len(force), np.bool_), np.zeros(len(force))
    near[bearing] = True
    near = _greatest_around(near.reshape(shape)).reshape(-1)
    for n in range(len(force)):
        around[n] = np.sqrt(force[n, 0] ** 2 + force[n, 1] ** 2 + force[n, 2] ** 2)
    around = _greatest_around(around.reshape(shape)).reshape(-1)
    std: Array = np.empty(force.shape)
    for n in range(len(force)):
        for c in range(3):
            known = noise_squared * variance[n, c] if near[n] else alone[n] ** 2
            std[n, c] = np.sqrt(known + (NODE_STD_SHARE * around[n] * NODE_STD_BY_AXIS[c]) ** 2)
    return std


@kernel_part
def _greatest_around(grid: Grid) -> Grid:
    """The greatest of each value of a grid (rows, cols) and its eight neighbours."""
    rows, cols = grid.shape
    found: Grid = grid.copy()
    for i in range(rows):
        for j in range(cols):
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    found[i, j] = max(found[i, j], grid[k, m])
    return found
