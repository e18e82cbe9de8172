"""Second pass: the traction on the nodes that are in contact, all others being free of it.

The posterior of a linear model with Gaussian noise and a smooth prior.  How large normal and
tangential traction are expected to be follows from the first pass, and the noise from what the
solution leaves over.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.force.contact_factor import (
    ComplementFactor,
    DirectFactor,
    Factor,
    UpdatedFactor,
    WholeSurface,
    weighted_equations,
)
from cmp_tactile_processing.force.traction_spectrum import (
    MIN_NOISE_SQUARED,
    TractionScale,
    TractionSpectrum,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Value = TypeVar("Value")

# The expected tangential traction is at least this share of the normal one.
MIN_TANGENTIAL_SHARE = 0.02
MIN_NORMAL_N = 1e-9
# Weights of the smoothness are taken from this grid, in decades: a fifth of a size, which changes
# the forces by a fraction of their deviations, so that a factor serves many frames.
WEIGHT_STEP = 0.4
# Standard deviation of a weight's logarithm: what the grid and one step of MacKay's rule leave.
LOG_WEIGHT_STD = 0.5
# MacKay's rule goes about half of the way to the likeliest size if the data say little, and all of
# it if they say much.
MACKAY_STEP_FACTOR = 1.4
# Steps on the grid below which weights stay as they are: that is about their doubt.
NEAR_STEPS = 1.0
# The number of well determined parameters is computed in full on at most this many nodes, or if
# more than this share of the data is missing; else as if the whole surface were in contact and
# seen.
MAX_TRACED_NODES = 100
MAX_UNTRACED_MISSING_SHARE = 0.05
# Variance factor of nodes that enter or leave a mask: they do so in threes, as neighbours.
JOINT_NODE_FACTOR = 3.0
# Masks of more than this share of the nodes are solved by their complement,
MIN_WIDE_SHARE = 0.5
# if fewer data than this share of the unknowns are missing.
MAX_WIDE_MISSING_SHARE = 0.15
# Factors that are kept, for masks that come and go.
KEPT_FACTORS = 8
# Bytes of inverses that are kept, for a press that grows and falls: twenty of 20 x 20 nodes.
KEPT_BYTES = 90e6


class Weights(NamedTuple):
    """Weights of the smoothness of tangential and normal coefficients, squared noise being 1."""

    tangential: float
    normal: float


class SeenData(NamedTuple):
    """Data (m,) in units of the noise, 0 where they are not known; known (m,).

    pull (3 nodes,): G' d.  missing: bytes of the numbers of those that are not known.
    """

    data: Array
    known: Mask
    pull: Array
    missing: bytes

    @property
    def missing_share(self) -> float:
        """Of all data, those that are not known."""
        return len(np.frombuffer(self.missing, np.intp)) / len(self.data)


@dataclass(frozen=True)
class TractionPosterior:
    """Coefficients on the nodes of the mask, and how well they are known.

    nodes (k,): numbers.  coefficient (3 k,) N.  noise_squared: of the data.  weights: of their
    prior.  factor: inverse (3 k, 3 k) of the normal equations, the covariance for noise of 1.
    drift (3 k, 2): what a change of the two weights' logarithms adds to the normal equations.
    edge: how many of the nodes, the last ones, a little more noise would have left out of the mask,
    so that whether they bear anything is in doubt.
    """

    nodes: NDArray[np.intp]
    coefficient: Array
    noise_squared: float
    weights: Weights
    factor: Factor
    drift: Array
    edge: int = 0

    def covariances(self, functionals: Array) -> tuple[Array, Array]:
        """Covariance (j, j) of linear functionals (j, 3 k) of the coefficients, for these weights.

        With it what weights and edge leave open on top of that, (j, j).
        """
        count = len(functionals)
        at, pull = self._edge_pull
        joint, rows = self.factor.joint(np.hstack([functionals.T, self.drift]), at)
        of_weights = LOG_WEIGHT_STD * joint[:count, count:]
        # How functionals change where a node of the edge is free of traction.
        lost = (rows[:, :count] * pull[:, None]).reshape(-1, 3, count).sum(axis=1)
        doubt = of_weights @ of_weights.T + JOINT_NODE_FACTOR * lost.T @ lost
        return self.noise_squared * joint[:count, :count], doubt

    @cached_property
    def _edge_pull(self) -> tuple[NDArray[np.intp], Array]:
        """Unknowns of the edge, and what has to pull at each for it to bear nothing."""
        at = np.arange(len(self.coefficient) - 3 * self.edge, len(self.coefficient))
        return at, self.coefficient[at] / self.factor.variance(at)


class ContactTraction:
    """Solves for the coefficients on some of the nodes.

    response G (3 markers, 3 nodes): displacement in units of its noise, per N.
    smoothness (nodes, nodes): precision of one component.

    Factors are kept by what they follow from, the mask, the weights and which data are missing, so
    that a solution owes nothing to those before it.
    """

    def __init__(self, spectrum: TractionSpectrum, response: Array, smoothness: Array) -> None:
        self._spectrum, self._response, self._smoothness = spectrum, response, smoothness
        self._normal = np.asarray(response.T @ response)
        self._felt = response.any(axis=1)
        size = 1.5 * sum(part.gram.nbytes for part in spectrum.parts)
        self._factors: _Kept[Factor] = _Kept(KEPT_FACTORS)
        self._direct: _Kept[DirectFactor] = _Kept(KEPT_FACTORS)
        self._inverses: _Kept[WholeSurface] = _Kept(max(2, int(KEPT_BYTES / size)))
        self._variances: _Kept[Array] = _Kept(KEPT_FACTORS)
        self._smooth: _Kept[Array] = _Kept(KEPT_FACTORS)

    def is_wide(self, nodes: NDArray[np.intp]) -> bool:
        """Whether nodes (k,) are most of the surface, so that less is beside them."""
        return len(nodes) > MIN_WIDE_SHARE * len(self._smoothness)

    def weights(self, scale: TractionScale, noise_squared: float) -> Weights:
        """Weights for coefficients of an expected size, the nearest on the grid."""
        steps = np.round(self._steps(scale, noise_squared))
        return Weights(*(self._spectrum.scale * 10.0 ** (WEIGHT_STEP * steps)).tolist())

    def _steps(self, scale: TractionScale, noise_squared: float) -> Array:
        """Where on the grid the two weights are for coefficients of an expected size, (2,)."""
        normal = max(scale.normal, MIN_NORMAL_N)
        sizes = np.array([max(scale.tangential, MIN_TANGENTIAL_SHARE * normal), normal])
        return np.asarray(np.log10(noise_squared / sizes**2 / self._spectrum.scale) / WEIGHT_STEP)

    def seen(self, data: Array, known: Mask) -> SeenData:
        """What of data (m,), in units of the noise, counts: the `known`."""
        data = np.where(known, data, 0.0)
        missing = np.flatnonzero(~known & self._felt)
        return SeenData(data, known, self._spectrum.pull(data), missing.tobytes())

    def solve(self, seen: SeenData, nodes: NDArray[np.intp], weights: Weights) -> TractionPosterior:
        """Posterior given what is seen.

        nodes (k,): where there may be traction.  Raises InputError for no nodes.
        """
        if not len(nodes):
            msg = "nodes: found none, expected at least 1"
            raise InputError(msg)
        key = weights, nodes.tobytes(), seen.missing
        factor = self._factors.get(key, lambda: self._new_factor(nodes, weights, seen))
        return self._posterior(seen, nodes, weights, factor)

    def likelier(self, posterior: TractionPosterior, seen: SeenData) -> Weights:
        """Weights for the size that the coefficients show; the posterior's where they are near."""
        scale, noise = self._scale(posterior, seen), posterior.noise_squared
        own = np.log10(np.array(posterior.weights) / self._spectrum.scale) / WEIGHT_STEP
        if np.abs(self._steps(scale, noise) - own).max() <= NEAR_STEPS:
            return posterior.weights
        return self.weights(scale, noise)

    def _scale(self, posterior: TractionPosterior, seen: SeenData) -> TractionScale:
        """From the sizes that the weights stand for towards likelier ones, by MacKay's rule."""
        nodes, (tangential, normal) = posterior.nodes, posterior.weights
        # The drift is what the weighted smoothness makes of the coefficients.
        energy = posterior.coefficient @ posterior.drift / (tangential, normal)
        if _is_traced(nodes, seen) and isinstance(posterior.factor, DirectFactor):
            trace = posterior.factor.trace(self._smooth_on(nodes))
            left = tangential * trace[:2].sum(), normal * trace[2]
            determined = np.array([2.0, 1.0]) * len(nodes) - left
        else:
            determined = self._spectrum.determined(*posterior.weights)
            determined = determined * len(nodes) / len(self._smoothness)
        sizes = np.sqrt(energy / np.maximum(determined, 1.0))
        before = np.sqrt(posterior.noise_squared / np.array(posterior.weights))
        sizes = before * (sizes / before) ** MACKAY_STEP_FACTOR
        return TractionScale(float(sizes[1]), float(sizes[0]))

    def again(self, posterior: TractionPosterior, seen: SeenData) -> TractionPosterior:
        """The posterior for other data of the same markers, on the same nodes, with the weights."""
        found = self._posterior(seen, posterior.nodes, posterior.weights, posterior.factor)
        return replace(found, edge=posterior.edge)

    def nodal_variance(self, weights: Weights) -> Array:
        """As TractionSpectrum.nodal_variance."""
        return self._variances.get(weights, lambda: self._spectrum.nodal_variance(*weights))

    def _posterior(
        self,
        seen: SeenData,
        nodes: NDArray[np.intp],
        weights: Weights,
        factor: Factor,
    ) -> TractionPosterior:
        pull = seen.pull[unknowns_of(nodes)]
        coefficient = factor.solve(pull[:, None])[:, 0]
        # That of the greatest evidence for these weights.
        left = float(seen.data @ seen.data - coefficient @ pull)
        noise = max(left / np.count_nonzero(seen.known), MIN_NOISE_SQUARED)
        smoothed = self._smoothed(nodes, coefficient.reshape(-1, 3))
        drift = np.zeros((len(pull), 2))
        drift[0::3, 0], drift[1::3, 0] = weights.tangential * smoothed[:, :2].T
        drift[2::3, 1] = weights.normal * smoothed[:, 2]
        return TractionPosterior(nodes, coefficient, noise, weights, factor, drift)

    def _new_factor(self, nodes: NDArray[np.intp], weights: Weights, seen: SeenData) -> Factor:
        unknowns = unknowns_of(nodes)
        gone = self._response[np.frombuffer(seen.missing, np.intp)]
        if self.is_wide(nodes) and len(gone) < MAX_WIDE_MISSING_SHARE * len(unknowns):
            whole = self._inverses.get(weights, lambda: WholeSurface(self._spectrum, *weights))
            return ComplementFactor(whole, unknowns, gone)
        of_contact = gone.take(unknowns, axis=1)
        if len(gone) and _is_traced(nodes, seen):
            return self._direct_factor(nodes, weights, of_contact)
        complete = self._direct.get(
            (weights, nodes.tobytes()),
            lambda: self._direct_factor(nodes, weights, of_contact[:0]),
        )
        return UpdatedFactor(complete, of_contact) if len(gone) else complete

    def _direct_factor(
        self, nodes: NDArray[np.intp], weights: Weights, gone: Array
    ) -> DirectFactor:
        """gone (q, 3 k): response at data that are not known."""
        matrix = weighted_equations(self._normal, self._smoothness, nodes, *weights)
        if len(gone):
            matrix -= gone.T @ gone
        return DirectFactor(matrix)

    def _smooth_on(self, nodes: NDArray[np.intp]) -> Array:
        """Smoothness (k, k) of one component on some nodes."""
        return self._smooth.get(
            nodes.tobytes(), lambda: self._smoothness.take(nodes, axis=0).take(nodes, axis=1)
        )

    def _smoothed(self, nodes: NDArray[np.intp], values: Array) -> Array:
        """Smoothness times values (k, 3) on some nodes."""
        if not self.is_wide(nodes):
            return np.asarray(self._smooth_on(nodes) @ values)
        whole = np.zeros((len(self._smoothness), 3))
        whole[nodes] = values
        return np.asarray(self._spectrum.smoothed(whole)[nodes])


def _is_traced(nodes: NDArray[np.intp], seen: SeenData) -> bool:
    """Whether a trace of the inverse itself is needed."""
    return len(nodes) <= MAX_TRACED_NODES or seen.missing_share > MAX_UNTRACED_MISSING_SHARE


class _Kept(Generic[Value]):
    """The latest values, by what they follow from."""

    def __init__(self, most: int) -> None:
        self._most, self._values = most, OrderedDict[Hashable, Value]()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made where it is not kept."""
        if key not in self._values:
            self._values[key] = make()
        self._values.move_to_end(key)
        if len(self._values) > self._most:
            self._values.popitem(last=False)
        return self._values[key]


def unknowns_of(nodes: NDArray[np.intp]) -> NDArray[np.intp]:
    """Numbers (3 k,) of the coefficients of nodes (k,)."""
    return np.asarray((3 * nodes[:, None] + np.arange(3)).ravel())
