"""Compressible neo-Hookean material in second-order hexahedra that do not lock.

Energy per undeformed volume, F the deformation gradient, J = det F, C = F^T F:

    psi = mu/2 (tr C - 3 - 2 ln J)  +  lambda/2 (J - 1)^2

with the moduli of Lame. The first term is integrated on 3 x 3 x 3 points and the second on
2 x 2 x 2, which are the shear and the volumetric term of
`cmp_tactile_processing.elastic_stiffness` once linearised at rest: this material is that one for
small strains, to the last digit. A split into J^(-2/3) tr C and a bulk term would not be, since
it moves a third of mu from one rule to the other. Of the usual volumetric terms (J - 1)^2 is
taken because with it psi is convex in F and J (polyconvex), so that a state of least energy
exists; (ln J)^2 loses that beyond J = e and grows weaker with the volume.
Source of the forms: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.elastic_stiffness import (
    FULL_ORDER,
    REDUCED_ORDER,
    point_tables,
    second_order_mesh,
)
from cmp_tactile_processing.elastomer_mesh import BlockMesh

__all__ = ["Equilibrium", "NeoHookeanElements", "PointTable"]

SHAPES = 27


class PointTable(NamedTuple):
    """Integration points of all elements and the moduli that count there.

    gradients (elements, points, 27, 3): of the shapes, at rest, 1/m.  weights (elements, points)
    m^3.  shear, bulk (elements,): mu and lambda, Pa; zero where the rule leaves the term out.
    """

    gradients: NDArray[np.float64]
    weights: NDArray[np.float64]
    shear: NDArray[np.float64]
    bulk: NDArray[np.float64]

    def deformation(self, element_displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Deformation gradients (elements, points, 3, 3)."""
        moved = element_displacement.swapaxes(1, 2)[:, None] @ self.gradients
        return np.asarray(moved + np.eye(3), dtype=np.float64)


@dataclass(frozen=True)
class Equilibrium:
    """What the material holds against its deformation.

    energy: J; infinite where an element is turned inside out (J <= 0).
    force: (nodes, 3) N, gradient of the energy, what has to pull at the nodes.
    """

    energy: float
    force: NDArray[np.float64]


@dataclass(frozen=True)
class NeoHookeanElements:
    """All elements of a block.

    nodes (elements, 27): lattice nodes n = (ix * ny + iy) * nz + iz; elements are in the order
    of their place, x first, z last.  full, reduced: the two rules.
    """

    nodes: NDArray[np.intp]
    node_count: int
    full: PointTable
    reduced: PointTable

    @classmethod
    def of(
        cls, mesh: BlockMesh, poisson: float, young: float = 1.0, layer_young: float = 1.0
    ) -> NeoHookeanElements:
        """Elements of a block of the given moduli at small strain, Pa."""
        fem, lattice = second_order_mesh(mesh)
        full, reduced = point_tables(fem, FULL_ORDER), point_tables(fem, REDUCED_ORDER)
        nodes = lattice[full[0]].T
        order = np.argsort(nodes.min(axis=1))
        above = (nodes[order] % mesh.lattice[2] > mesh.marker_level).any(axis=1)
        modulus = np.where(above, layer_young, young)
        shear = modulus / (2 * (1 + poisson))
        bulk = 2 * shear * poisson / (1 - 2 * poisson)
        none = np.zeros_like(shear)
        return cls(
            nodes[order],
            len(lattice),
            PointTable(*_sorted(full, order), shear, none),
            PointTable(*_sorted(reduced, order), none, bulk),
        )

    def equilibrium(self, displacement: NDArray[np.float64]) -> Equilibrium:
        """Energy and nodal forces at a displacement (nodes, 3) m."""
        local = displacement[self.nodes]
        energy, force = 0.0, np.zeros_like(local)
        for rule in (self.full, self.reduced):
            part = np.empty(len(local))
            _add_force(rule, local, force, part)
            energy += float(part.sum())
        return Equilibrium(energy, np.asarray(self._gather @ force.reshape(-1, 3)))

    def tangent(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Second derivative of the energy per element, (elements, 81, 81) N/m.

        The local degree of freedom 3 a + c is component c of the element's node a. No element
        may be turned inside out.
        """
        local = displacement[self.nodes]
        stiffness: NDArray[np.float64] = self._stiffness_of_dilation.copy()
        for rule in (self.full, self.reduced):
            _add_tangent(rule, local, stiffness)
        return stiffness.reshape(len(local), 3 * SHAPES, 3 * SHAPES)

    def greatest_stretch(self, displacement: NDArray[np.float64]) -> float:
        """Greatest ratio of deformed to undeformed length at any integration point."""
        gradient = self.full.deformation(displacement[self.nodes])
        return float(np.linalg.norm(gradient, ord=2, axis=(-2, -1)).max())

    @cached_property
    def _gather(self) -> sparse.csr_array:
        """Sums what the elements give to each node, always in the same order."""
        index = self.nodes.ravel()
        entries = np.ones(len(index)), (index, np.arange(len(index)))
        return sparse.coo_array(entries, shape=(self.node_count, len(index))).tocsr()

    @cached_property
    def _stiffness_of_dilation(self) -> NDArray[np.float64]:
        """The share of tr C in the tangent, which does not change, (elements, 27, 3, 27, 3)."""
        flat = self.full.gradients.swapaxes(1, 2).reshape(len(self.nodes), SHAPES, -1)
        weights = np.repeat(self.full.weights * self.full.shear[:, None], 3, axis=1)
        dot = (flat * weights[:, None]) @ flat.swapaxes(1, 2)
        return np.asarray(dot[:, :, None, :, None] * np.eye(3)[:, None])


def _sorted(
    table: tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]],
    order: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients and weights with the elements first and in the given order."""
    _, gradients, weights = table
    return np.ascontiguousarray(gradients.swapaxes(0, 1)[order]), weights[order]


@njit(cache=True, nogil=True)
def _stretch(
    displacement: NDArray[np.float64],
    gradient: NDArray[np.float64],
    h: NDArray[np.float64],
    c: NDArray[np.float64],
) -> float:
    """Write the displacement gradient into h, its cofactors into c; return det(1 + h) - 1.

    Nothing is taken from 1, so that the smallest of strains keeps all its digits.
    """
    h[:] = 0.0
    for a in range(SHAPES):
        for i in range(3):
            for j in range(3):
                h[i, j] += displacement[a, i] * gradient[a, j]
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            n, p = (j + 1) % 3, (j + 2) % 3
            c[i, j] = h[k, n] * h[m, p] - h[k, p] * h[m, n]
    determinant = h[0, 0] * c[0, 0] + h[0, 1] * c[0, 1] + h[0, 2] * c[0, 2]
    return float(np.trace(h) + np.trace(c) + determinant)


@njit(cache=True, nogil=True)
def _cofactor(h: NDArray[np.float64], c: NDArray[np.float64]) -> Any:
    """Cofactors of F = 1 + h, det(F) F^-T, from h and its own cofactors c."""
    return (1 + np.trace(h)) * np.eye(3) - h.T + c


@njit(cache=True, nogil=True)
def _add_force(
    rule: PointTable,
    displacement: NDArray[np.float64],
    force: NDArray[np.float64],
    energy: NDArray[np.float64],
) -> None:
    """Add each element's nodal forces (elements, 27, 3); write its energy."""
    h, c = np.empty((3, 3)), np.empty((3, 3))
    for e in range(len(displacement)):
        mu, bulk = rule.shear[e], rule.bulk[e]
        energy[e] = 0.0
        for q in range(rule.weights.shape[1]):
            growth = _stretch(displacement[e], rule.gradients[e, q], h, c)
            if growth <= -1:
                energy[e] = np.inf
                continue
            trace, weight = np.trace(h), rule.weights[e, q]
            # tr C - 3 - 2 ln J, and F - F^-T
            distortion = 2 * (trace - np.log1p(growth)) + np.sum(h * h)
            shear = h + ((growth - trace) * np.eye(3) + h.T - c) / (1 + growth)
            energy[e] += weight * (mu / 2 * distortion + bulk / 2 * growth**2)
            stress = weight * (mu * shear + bulk * growth * _cofactor(h, c))
            for a in range(SHAPES):
                for i in range(3):
                    for j in range(3):
                        force[e, a, i] += stress[i, j] * rule.gradients[e, q, a, j]


@njit(cache=True, nogil=True)
def _add_outer(factor: float, v: NDArray[np.float64], total: NDArray[np.float64]) -> None:
    """Add factor * v v^T."""
    for row in range(len(v)):
        scaled = factor * v[row]
        for col in range(len(v)):
            total[row, col] += scaled * v[col]


@njit(cache=True, nogil=True)
def _add_straight_and_crossed(
    straight: NDArray[np.float64], crossed: NDArray[np.float64], stiffness: NDArray[np.float64]
) -> None:
    for a in range(SHAPES):
        for i in range(3):
            for b in range(SHAPES):
                for j in range(3):
                    stiffness[a, i, b, j] += (
                        straight[3 * a + i, 3 * b + j] + crossed[3 * a + j, 3 * b + i]
                    )


@njit(cache=True, nogil=True)
def _add_tangent(
    rule: PointTable,
    displacement: NDArray[np.float64],
    stiffness: NDArray[np.float64],
) -> None:
    """Add what the terms in J give to each element, (elements, 27, 3, 27, 3).

    With spatial gradients s_a = F^-T grad N_a the terms in J give
    straight * s_a[i] s_b[j] + crossed * s_a[j] s_b[i] for components i of a, j of b.
    """
    h, c = np.empty((3, 3)), np.empty((3, 3))
    spatial = np.empty(3 * SHAPES)
    for e in range(len(displacement)):
        mu, bulk = rule.shear[e], rule.bulk[e]
        straight, crossed = np.zeros((2, 3 * SHAPES, 3 * SHAPES))
        for q in range(rule.weights.shape[1]):
            growth = _stretch(displacement[e], rule.gradients[e, q], h, c)
            volume, weight = 1 + growth, rule.weights[e, q]
            inverse = _cofactor(h, c) / volume
            for a in range(SHAPES):
                for i in range(3):
                    spatial[3 * a + i] = 0.0
                    for j in range(3):
                        spatial[3 * a + i] += inverse[i, j] * rule.gradients[e, q, a, j]
            _add_outer(weight * (mu - bulk * volume * growth), spatial, crossed)
            if bulk != 0:
                _add_outer(weight * bulk * volume * (volume + growth), spatial, straight)
        _add_straight_and_crossed(straight, crossed, stiffness[e])
