"""Compressible neo-Hookean material in second-order hexahedra that do not lock.

Energy per undeformed volume, F the deformation gradient, J = det F, C = F^T F:

    psi = mu/2 (tr C - 3 - 2 ln J)  +  lambda/2 (J - 1)^2

with the moduli of Lame. The first term is integrated on 3 x 3 x 3 points and the second on
2 x 2 x 2, which are the shear and the volumetric term of
`cmp_tactile_processing.elastic.stiffness` once linearised at rest: this material is that one for
small strains, to the last digit. A split into J^(-2/3) tr C and a bulk term would not be, since
it moves a third of mu from one rule to the other. Of the usual volumetric terms (J - 1)^2 is
taken because with it psi is convex in F and J (polyconvex), so that a state of least energy
exists; (ln J)^2 loses that beyond J = e and grows weaker with the volume.
Source of the forms: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.elastomer_mesh import BlockMesh
from cmp_tactile_processing.elastic.neo_hookean_kernels import (
    FULL,
    POINTS,
    REDUCED,
    SHAPES,
    FlatPoints,
    PointTable,
    add_force,
    add_tangent,
)
from cmp_tactile_processing.elastic.quadratic_line import interpolation, interpolation_slope

__all__ = ["Equilibrium", "NeoHookeanElements", "PointTable"]


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

    nodes (elements, 27): lattice nodes n = (ix * ny + iy) * nz + iz; elements and the nodes of
    each are in the order of their place, x first, z last.  shear, bulk (elements,): mu and
    lambda, Pa.
    slopes (27, 3, POINTS): of the shapes along the axes of the reference cube [0, 1]^3.
    inverse (elements, 3, 3, POINTS): [k, j] is the slope of reference coordinate k along j, 1/m.
    weights (elements, POINTS): m^3, of both rules one after the other; the last is 0.
    """

    nodes: NDArray[np.intp]
    node_count: int
    shear: NDArray[np.float64]
    bulk: NDArray[np.float64]
    slopes: NDArray[np.float64]
    inverse: NDArray[np.float64]
    weights: NDArray[np.float64]

    @classmethod
    def from_mesh(
        cls, mesh: BlockMesh, poisson: float, young: float = 1.0, layer_young: float = 1.0
    ) -> NeoHookeanElements:
        """Elements of a block of the given moduli at small strain, Pa."""
        lattice = np.arange(np.prod(mesh.lattice)).reshape(mesh.lattice)
        cubes = np.lib.stride_tricks.sliding_window_view(lattice, (3, 3, 3))[::2, ::2, ::2]
        nodes = np.ascontiguousarray(cubes.reshape(-1, SHAPES))
        above = (nodes % mesh.lattice[2] > mesh.marker_level).any(axis=1)
        shear = np.where(above, layer_young, young) / (2 * (1 + poisson))
        bulk = 2 * shear * poisson / (1 - 2 * poisson)
        slopes, rule = _reference()
        points = mesh.nodes().reshape(-1, 3)[nodes]
        jacobian = np.einsum("eaj,akq->eqjk", points, slopes[..., :-1], optimize=True)
        inverse = np.zeros((len(nodes), 3, 3, POINTS))
        inverse[..., :-1] = np.moveaxis(np.linalg.inv(jacobian), 1, -1)
        weights = np.zeros((len(nodes), POINTS))
        weights[:, :-1] = np.linalg.det(jacobian) * rule
        return cls(nodes, lattice.size, shear, bulk, slopes, inverse, weights)

    def equilibrium(self, displacement: NDArray[np.float64]) -> Equilibrium:
        """Energy and nodal forces at a displacement (nodes, 3) m."""
        force = np.zeros((self.node_count, 3))
        place = np.ascontiguousarray(displacement, dtype=np.float64)
        energy = add_force(self._points, self.nodes, place, force)
        return Equilibrium(energy, force)

    def tangent(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Second derivative of the energy per element, (elements, 81, 81) N/m.

        The local degree of freedom 3 a + c is component c of the element's node a. No element
        may be turned inside out.
        """
        local = displacement[self.nodes]
        stiffness: NDArray[np.float64] = self._stiffness_of_dilation.copy()
        for rule in (self.full, self.reduced):
            add_tangent(rule, local, stiffness)
        return stiffness.reshape(len(local), 3 * SHAPES, 3 * SHAPES)

    def greatest_stretch(self, displacement: NDArray[np.float64]) -> float:
        """Greatest ratio of deformed to undeformed length at any integration point."""
        gradient = self.full.deformation(displacement[self.nodes])
        return float(np.linalg.norm(gradient, ord=2, axis=(-2, -1)).max())

    @cached_property
    def full(self) -> PointTable:
        """The points of the shear term."""
        return self._rule(slice(0, FULL**3), self.shear, np.zeros_like(self.bulk))

    @cached_property
    def reduced(self) -> PointTable:
        """The points of the volumetric term."""
        return self._rule(slice(FULL**3, -1), np.zeros_like(self.shear), self.bulk)

    def _rule(
        self, points: slice, shear: NDArray[np.float64], bulk: NDArray[np.float64]
    ) -> PointTable:
        parts = self.slopes[..., points], self.inverse[..., points]
        gradients = np.einsum("akq,ekjq->eqaj", *parts, optimize=True)
        weights = np.ascontiguousarray(self.weights[:, points])
        return PointTable(np.ascontiguousarray(gradients), weights, shear, bulk)

    @cached_property
    def _points(self) -> FlatPoints:
        moduli = np.zeros((len(self.nodes), 2, POINTS))
        moduli[:, 0, : FULL**3] = self.weights[:, : FULL**3] * self.shear[:, None]
        moduli[:, 1, FULL**3 :] = self.weights[:, FULL**3 :] * self.bulk[:, None]
        return FlatPoints(moduli, self.slopes.ravel(), self.inverse.ravel())

    @cached_property
    def _stiffness_of_dilation(self) -> NDArray[np.float64]:
        """The share of tr C in the tangent, which does not change, (elements, 27, 3, 27, 3)."""
        full = self.full
        flat = full.gradients.swapaxes(1, 2).reshape(len(self.nodes), SHAPES, -1)
        weights = np.repeat(full.weights * full.shear[:, None], 3, axis=1)
        dot = (flat * weights[:, None]) @ flat.swapaxes(1, 2)
        return np.asarray(dot[:, :, None, :, None] * np.eye(3)[:, None])


def _reference() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of the shapes in the reference cube (27, 3, POINTS), and weights of the points."""
    slopes, weights = np.zeros((SHAPES, 3, POINTS)), []
    first = 0
    for count in (FULL, REDUCED):
        at, weight = np.polynomial.legendre.leggauss(count)
        at, weight = (at + 1) / 2, weight / 2
        edges = np.array([0.0, 1.0])
        value, slope = interpolation(edges, at), interpolation_slope(edges, at)
        last = first + count**3
        for axis in range(3):
            lines = [slope if axis == line else value for line in range(3)]
            product = np.einsum("pa,qb,rc->abcpqr", *lines)
            slopes[:, axis, first:last] = product.reshape(SHAPES, -1)
        weights.append(np.einsum("p,q,r->pqr", weight, weight, weight).ravel())
        first = last
    return slopes, np.concatenate(weights)
