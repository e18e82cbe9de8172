"""Two-pass reconstruction of the nodal forces from displacements in units of their noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.elastic.mirror_symmetry import Rows, SparseRows
from cmp_tactile_processing.force.contact_mask import ContactRule
from cmp_tactile_processing.force.contact_regions import resultant_matrix
from cmp_tactile_processing.force.contact_traction import (
    ContactTraction,
    TractionPosterior,
    TractionScale,
)
from cmp_tactile_processing.force.traction_spectrum import (
    TANGENTIAL_SHARE,
    FirstPass,
    TractionSpectrum,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parameters import ForceParameters

# Of the largest force around a node, what the shape of the hats leaves open of its own along z, as
# contacts solved on finer nodes show it, and of that the share along x and y.
UNSEEN_SHARE, UNSEEN_COMPONENTS = 0.02, np.array([0.5, 0.5, 1.0])
# Weight of the first pass that the deviations of a wrench at rest hold for.
REST_WEIGHT = 1e-6
# The second pass has left something out where it leaves so many times the first one's misfit,
# squared; else it is mostly below 1.1.  What it left out is added so often at most.
LEFT_OUT, ADDED = 1.2, 2
# Markers that have moved by no force, as those of another reference, are explained by weak loads
# all over, and so is a gel that does not quite follow the model.  So nothing is added where the
# second pass leaves a larger share of the displacement beside the noise, where more than this
# share of the nodes would be loaded, or where with it the squared misfit is still so many times
# the first pass's.
MOST_LEFT, ALL_OVER, EXPLAINED = 0.3, 0.5, 2.0


@dataclass(frozen=True)
class ForceSolution:
    """Nodal forces and what they explain.

    force (nodes, 3) N: consistent nodal forces, 0 outside the mask.  force_std (nodes, 3) N.
    coefficient (nodes, 3) N: of the hats.
    predicted (markers, 3): displacement in units of its noise.  loaded: whether there is any
    force that is not noise.  posterior: of the second pass, None without one.
    noise_squared: of the data over what the parameters say.
    """

    force: NDArray[np.float64]
    force_std: NDArray[np.float64]
    coefficient: NDArray[np.float64]
    predicted: NDArray[np.float64]
    loaded: bool
    first: FirstPass
    posterior: TractionPosterior | None
    noise_squared: float


@dataclass(frozen=True)
class _Settled:
    """Where the scale of a frame has settled: share of what the first pass gives, and its noise.

    count: of the data that were known.
    """

    share: TractionScale
    noise_squared: float
    count: int


class ForceSolver:
    """Inverts one response.

    response (3 markers, 3 nodes): displacement in units of its noise, per N.
    """

    def __init__(
        self,
        markers: SurfaceGrid,
        nodes: SurfaceGrid,
        response: NDArray[np.float64],
        parameters: ForceParameters,
    ) -> None:
        self._parameters = parameters
        self._shape = nodes.rows, nodes.cols
        self.rule = ContactRule(parameters, self._shape, nodes.spacing[0] * nodes.spacing[1])
        one = smoothness(nodes, parameters.smoothing_length)
        components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
        lumped = sparse.csr_array(nodal_force_matrix(nodes))
        self._lumped, self._spread = SparseRows(lumped), SparseRows(lumped.T)
        self.nodal = sparse.csr_array(sparse.kron(lumped, sparse.eye_array(3)))
        precision = np.asarray(np.kron(one, components), np.float64)
        self._spectrum = TractionSpectrum(markers, nodes, response, precision, self.nodal)
        self._second = ContactTraction(response, self._spectrum.pull, one)
        self.reset()
        # Compiled, or read from numba's cache, before the first frame.
        count = self._shape[0] * self._shape[1]
        forces = _nodal_forces(self._lumped.rows, np.full(count, -1), np.zeros((2, 0)))
        _deviations(*forces, np.zeros(count), self._shape)
        self.functionals(np.zeros((count, 3)), np.ones(count), np.arange(count))

    def reset(self) -> None:
        """Forget where the scale of the last frame has settled."""
        self._settled: dict[int, _Settled] = {}

    def solve(self, data: NDArray[np.float64], known: NDArray[np.bool_]) -> ForceSolution:
        """Forces from data (3 markers,), in units of the noise, of which the `known` count.

        How far the likeliest scale is from what the first pass gives is much the same in the next
        frame, so that its search begins there; where it ends does not depend on that.
        """
        weight = self._parameters.regularization**2 or None
        first = self._spectrum.solve(data, known, weight)
        force = self._lumped.of_columns(first.coefficient.reshape(-1, 3))
        if first.evidence < self._parameters.contact_evidence:
            return self._nothing(first)
        if not self._parameters.two_pass:
            return self._first_alone(first, force)
        mask = self.rule.loaded(force, first.nodal_std)
        if not mask.any():
            return self._nothing(first)
        nodes = np.flatnonzero(mask)
        posterior = self._likeliest(first, data, known, nodes)
        posterior = self._with_left_out(first, posterior, data, known)
        mask[posterior.nodes] = True
        posterior = replace(posterior, edge=self.rule.edge(mask)[posterior.nodes])
        return self._second_pass(first, posterior)

    def _likeliest(
        self,
        first: FirstPass,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
        nodes: NDArray[np.intp],
        before: tuple[int, TractionScale] | None = None,
    ) -> TractionPosterior:
        """The posterior on some nodes for its likeliest scale.

        before: how often nodes were added in this frame, and the scale without the last ones.
        """
        added, begin = before or (0, None)
        scale, count = _scale_of(first, nodes), int(np.count_nonzero(known))
        # Taken out, so that the next frame does not begin from where this one fails.
        last = self._settled.pop(added, None)
        if last is not None:
            begin = scale.times(last.share)
            if last.count != count:
                # The noise that the first pass finds changes with what it fills in.
                begin = replace(begin, noise_squared=last.noise_squared)
        posterior = self._second.solve(data, known, nodes, scale, begin)
        found = posterior.scale
        self._settled[added] = _Settled(found.over(scale), found.noise_squared, count)
        return posterior

    def _with_left_out(
        self,
        first: FirstPass,
        posterior: TractionPosterior,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
    ) -> TractionPosterior:
        """The posterior on a mask that holds weak loads beside a strong one, too.

        They are below a share of its peak, as is what rings around it.  What the second pass
        leaves over does not ring, and shows them.
        """
        begun = posterior
        for added in range(1, ADDED + 1):
            if posterior.scale.noise_squared <= LEFT_OUT * first.noise_squared:
                return posterior
            nodes = self._with_more(first, posterior, data, known)
            if nodes is None:
                break
            before = added, posterior.scale
            posterior = self._likeliest(first, data, known, nodes, before)
        explained = posterior.scale.noise_squared <= EXPLAINED * first.noise_squared
        return posterior if explained else begun

    def _with_more(
        self,
        first: FirstPass,
        posterior: TractionPosterior,
        data: NDArray[np.float64],
        known: NDArray[np.bool_],
    ) -> NDArray[np.intp] | None:
        """Nodes of the posterior and those that what it leaves over asks for, None for none."""
        if self._is_all_over(len(posterior.nodes)):
            return None
        predicted = self._spectrum.respond(self._on_all_nodes(posterior).ravel())
        rest = np.where(known, data - predicted, 0.0)
        of_noise = first.noise_squared * np.count_nonzero(known)
        if rest @ rest - of_noise > MOST_LEFT**2 * (data @ data):
            return None
        left = self._spectrum.solve(rest, known)
        if left.evidence < self._parameters.contact_evidence:
            return None
        force = self._lumped.of_columns(left.coefficient.reshape(-1, 3))
        before = np.zeros(len(force), dtype=bool)
        before[posterior.nodes] = True
        mask = before | self.rule.loaded(force, left.nodal_std)
        strange = self.rule.spans(mask) and not self.rule.spans(before)
        strange = strange or self._is_all_over(int(np.count_nonzero(mask)))
        return None if strange or (mask == before).all() else np.flatnonzero(mask)

    def _is_all_over(self, nodes: int) -> bool:
        return nodes > ALL_OVER * self._shape[0] * self._shape[1]

    def again(
        self, before: ForceSolution, data: NDArray[np.float64], known: NDArray[np.bool_]
    ) -> ForceSolution:
        """Coefficients for data that are nearly those of an earlier solution, with its mask.

        All else of it stays; `completed` brings it up to date.
        """
        if before.posterior is None:
            return self.solve(data, known)
        posterior = self._second.again(before.posterior, data, known)
        coefficient = self._on_all_nodes(posterior)
        return replace(before, coefficient=coefficient, posterior=posterior)

    def completed(self, solution: ForceSolution) -> ForceSolution:
        """Forces, deviations and prediction of what `again` gave."""
        if solution.posterior is None:
            return solution
        return self._second_pass(solution.first, solution.posterior)

    def functionals(
        self, place: NDArray[np.float64], weight: NDArray[np.float64], nodes: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Functionals (6, 3 k) of the mask's coefficients that give a wrench about the origin.

        Of nodal forces at place (nodes, 3), each counted with a weight (nodes,).
        """
        return _wrench_functionals(self._spread.rows, place, weight, nodes)

    def rest_covariance(self, functionals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of functionals (j, 3 nodes) of nodal forces that noise of 1 alone causes."""
        return self._spectrum.noise_covariance((self.nodal.T @ functionals.T).T, REST_WEIGHT)

    def _nothing(self, first: FirstPass) -> ForceSolution:
        self.reset()
        nodes = self._shape[0] * self._shape[1]
        std = np.repeat(first.nodal_std[:, None], 3, axis=1)
        markers = len(first.data) // 3
        nothing = np.zeros((nodes, 3))
        return ForceSolution(
            nothing, std, nothing, np.zeros((markers, 3)), False, first, None, first.noise_squared
        )

    def _first_alone(self, first: FirstPass, force: NDArray[np.float64]) -> ForceSolution:
        std = np.repeat(first.nodal_std[:, None], 3, axis=1)
        predicted = self._spectrum.respond(first.coefficient).reshape(-1, 3)
        coefficient = first.coefficient.reshape(-1, 3)
        return ForceSolution(
            force, std, coefficient, predicted, True, first, None, first.noise_squared
        )

    def _on_all_nodes(self, posterior: TractionPosterior) -> NDArray[np.float64]:
        coefficient = np.zeros((self._shape[0] * self._shape[1], 3))
        coefficient[posterior.nodes] = posterior.coefficient.reshape(-1, 3)
        return coefficient

    def _second_pass(self, first: FirstPass, posterior: TractionPosterior) -> ForceSolution:
        coefficient = self._on_all_nodes(posterior)
        place = np.full(len(coefficient), -1)
        place[posterior.nodes] = np.arange(len(posterior.nodes))
        drawn = np.vstack([posterior.coefficient, posterior.draws])
        force, variance = _nodal_forces(self._lumped.rows, place, drawn)
        return ForceSolution(
            force,
            _deviations(force, variance, first.nodal_std, self._shape),
            coefficient,
            self._spectrum.respond(coefficient.ravel()).reshape(-1, 3),
            True,
            first,
            posterior,
            posterior.scale.noise_squared,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _wrench_functionals(
    spread: Rows,
    place: NDArray[np.float64],
    weight: NDArray[np.float64],
    nodes: NDArray[np.intp],
) -> NDArray[np.float64]:
    """As ForceSolver.functionals; spread: from nodal forces to a hat's."""
    starts, columns, values = spread
    weights: NDArray[np.float64] = np.zeros(len(nodes))
    places: NDArray[np.float64] = np.zeros((len(nodes), 3))
    for row, node in enumerate(nodes):
        for k in range(starts[node], starts[node + 1]):
            share = values[k] * weight[columns[k]]
            weights[row] += share
            for c in range(3):
                places[row, c] += share * place[columns[k], c]
    return resultant_matrix(places, weights)


@njit(cache=True, nogil=True, error_model="numpy")
def _nodal_forces(
    lumped: Rows, place: NDArray[np.intp], drawn: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodal forces (nodes, 3) and the variance of their draws, 0 where there is none.

    lumped: from coefficients to nodal forces.  place (nodes,): of a node in the mask, -1 outside.
    drawn (1 + draws, 3 k): coefficients, then deviations.
    """
    starts, columns, values = lumped
    count, draws = len(place), len(drawn)
    force: NDArray[np.float64] = np.zeros((count, 3))
    variance: NDArray[np.float64] = np.zeros((count, 3))
    total: NDArray[np.float64] = np.empty((3, draws))
    for node in range(count):
        total[:] = 0.0
        for k in range(starts[node], starts[node + 1]):
            at = 3 * place[columns[k]]
            if at >= 0:
                for c in range(3):
                    for j in range(draws):
                        total[c, j] += values[k] * drawn[j, at + c]
        for c in range(3):
            force[node, c] = total[c, 0]
            for j in range(1, draws):
                variance[node, c] += total[c, j] * total[c, j] / (draws - 1)
    return force, variance


@njit(cache=True, nogil=True, error_model="numpy")
def _deviations(
    force: NDArray[np.float64],
    variance: NDArray[np.float64],
    of_noise: NDArray[np.float64],
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Deviations (nodes, 3) N of nodal forces (nodes, 3) whose draws have this variance.

    The mean over the neighbours that bear any; to that comes what hats cannot show of the forces
    around.  Outside of the mask a force may hide in the noise, of_noise (nodes,).
    """
    rows, cols = shape
    found: NDArray[np.float64] = np.empty(force.shape)
    size = np.sqrt(force[:, 0] ** 2 + force[:, 1] ** 2 + force[:, 2] ** 2)
    for i in range(rows):
        for j in range(cols):
            node, around = i * cols + j, 0.0
            total, bearing = np.zeros(3), np.zeros(3)
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    other = k * cols + m
                    around = max(around, size[other])
                    for c in range(3):
                        total[c] += variance[other, c]
                        bearing[c] += 1.0 if variance[other, c] > 0 else 0.0
            for c in range(3):
                borne = total[c] / bearing[c] if variance[node, c] > 0 else of_noise[node] ** 2
                unseen = UNSEEN_SHARE * around * UNSEEN_COMPONENTS[c]
                found[node, c] = np.sqrt(borne + unseen**2)
    return found


def _scale_of(first: FirstPass, nodes: NDArray[np.intp]) -> TractionScale:
    coefficient = first.coefficient.reshape(-1, 3)[nodes]
    squares = np.einsum("ij,ij->j", coefficient, coefficient).tolist()
    normal = max(sqrt(squares[2] / len(nodes)), 1e-6)
    tangential = sqrt((squares[0] + squares[1]) / (2 * len(nodes)))
    return TractionScale(normal, max(tangential, 0.1 * normal), first.noise_squared)
