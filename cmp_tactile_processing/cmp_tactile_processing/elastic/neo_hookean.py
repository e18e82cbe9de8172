"""Compressible neo-Hookean material in second-order hexahedra that do not lock.

Energy per undeformed volume, F the deformation gradient, J = det F, C = F^T F:

    psi = mu/2 (tr C - 3 - 2 ln J)  +  lambda/2 (J - 1)^2

with the moduli of Lame. The first term is integrated on 3 x 3 x 3 points and the second on
2 x 2 x 2, which are the shear and the volumetric term of `mesh.stiffness` once
linearised at rest: this material is that one for small strains, to the last digit. A split into
J^(-2/3) tr C and a bulk term would not be, since it moves a third of mu from one rule to the
other. Of the usual volumetric terms (J - 1)^2 is taken because with it psi is convex in F and J
(polyconvex), so that a state of least energy exists; (ln J)^2 loses that beyond J = e and grows
weaker with the volume.
Source of the forms: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.elastic.mesh import BlockMesh, interpolation, interpolation_slope

SHAPES = 27

# Points along a line of the rule for the shear term and of that for the volumetric term.
FULL, REDUCED = 3, 2
# Both rules' points side by side, with one more that counts for nothing: whole vectors of 4.
POINTS = FULL**3 + REDUCED**3 + 1

# All of numba's fast arithmetic but what takes infinities and NaN for impossible.
FAST = {"contract", "reassoc", "arcp", "nsz"}


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


class FlatPoints(NamedTuple):
    """What the force kernel reads in the order of its loops.

    moduli (elements, 2, POINTS): weights with the shear modulus and with the bulk's, N m.
    slopes, inverse: those of NeoHookeanElements, flat.
    """

    moduli: NDArray[np.float64]
    slopes: NDArray[np.float64]
    inverse: NDArray[np.float64]


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
        nodes = mesh.element_nodes()
        shear = np.where(mesh.is_layer(), layer_young, young) / (2 * (1 + poisson))
        bulk = 2 * shear * poisson / (1 - 2 * poisson)
        slopes, rule = _reference()
        points = mesh.nodes().reshape(-1, 3)[nodes]
        jacobian = np.einsum("eaj,akq->eqjk", points, slopes[..., :-1], optimize=True)
        inverse = np.zeros((len(nodes), 3, 3, POINTS))
        inverse[..., :-1] = np.moveaxis(np.linalg.inv(jacobian), 1, -1)
        weights = np.zeros((len(nodes), POINTS))
        weights[:, :-1] = np.linalg.det(jacobian) * rule
        return cls(nodes, int(np.prod(mesh.lattice)), shear, bulk, slopes, inverse, weights)

    def equilibrium(self, displacement: NDArray[np.float64]) -> Equilibrium:
        """Energy and nodal forces at a displacement (nodes, 3) m."""
        force = np.zeros((self.node_count, 3))
        place = np.ascontiguousarray(displacement, dtype=np.float64)
        energy = _add_force(self._points, self.nodes, place, force)
        return Equilibrium(energy, force)

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


@kernel(fastmath=FAST)
def _add_force(
    points: FlatPoints,
    nodes: NDArray[np.intp],
    displacement: NDArray[np.float64],
    force: NDArray[np.float64],
) -> float:
    """Add all elements' nodal forces (nodes, 3); return their energy, infinite where one is over.

    Offsets into flat arrays are constants, so that the compiler sees which of them lie apart and
    takes several points at once.
    """
    moduli, slopes, inverse = points
    energy = 0.0
    h = np.empty(9 * POINTS)
    growth, distortion = np.empty(POINTS), np.empty(POINTS)
    for e in range(len(nodes)):
        _reference_gradient(displacement, nodes[e], slopes, h)
        _stress(h, inverse[9 * POINTS * e : 9 * POINTS * (e + 1)], moduli[e], growth, distortion)
        for q in range(POINTS):
            if growth[q] <= -1:
                energy = np.inf
                continue
            shear = distortion[q] - 2 * np.log1p(growth[q])
            energy += moduli[e, 0, q] / 2 * shear + moduli[e, 1, q] / 2 * growth[q] ** 2
        for a in range(SHAPES):
            x, y, z = 0.0, 0.0, 0.0
            for p in range(3 * POINTS):
                slope = slopes[3 * POINTS * a + p]
                x += h[p] * slope
                y += h[3 * POINTS + p] * slope
                z += h[6 * POINTS + p] * slope
            node = nodes[e, a]
            force[node, 0] += x
            force[node, 1] += y
            force[node, 2] += z
    return energy


@kernel_part(fastmath=FAST)
def _reference_gradient(
    displacement: NDArray[np.float64],
    nodes: NDArray[np.intp],
    slopes: NDArray[np.float64],
    h: NDArray[np.float64],
) -> None:
    """Write the displacement's slopes along the reference axes, h[3 i + k, point]."""
    h[:] = 0.0
    for a in range(0, SHAPES, 3):
        first, second, third = nodes[a], nodes[a + 1], nodes[a + 2]
        for i in range(3):
            u, v, w = displacement[first, i], displacement[second, i], displacement[third, i]
            for p in range(3 * POINTS):
                h[3 * POINTS * i + p] += (
                    u * slopes[3 * POINTS * a + p]
                    + v * slopes[3 * POINTS * (a + 1) + p]
                    + w * slopes[3 * POINTS * (a + 2) + p]
                )


@kernel_part(fastmath=FAST)
def _stress(  # noqa: PLR0915
    g: NDArray[np.float64],
    inverse: NDArray[np.float64],
    moduli: NDArray[np.float64],
    growth: NDArray[np.float64],
    distortion: NDArray[np.float64],
) -> None:
    """Replace the slopes g[3 i + k, point] by weight times stress along the reference axes.

    Writes det F - 1, and tr C - 3 + 2 ln J.  Nothing is taken from 1, so that the smallest of
    strains keeps all its digits.
    """
    n = POINTS
    for q in range(POINTS):
        r00, r01, r02 = inverse[q], inverse[n + q], inverse[2 * n + q]
        r10, r11, r12 = inverse[3 * n + q], inverse[4 * n + q], inverse[5 * n + q]
        r20, r21, r22 = inverse[6 * n + q], inverse[7 * n + q], inverse[8 * n + q]
        g0, g1, g2 = g[q], g[n + q], g[2 * n + q]
        h00 = g0 * r00 + g1 * r10 + g2 * r20
        h01 = g0 * r01 + g1 * r11 + g2 * r21
        h02 = g0 * r02 + g1 * r12 + g2 * r22
        g0, g1, g2 = g[3 * n + q], g[4 * n + q], g[5 * n + q]
        h10 = g0 * r00 + g1 * r10 + g2 * r20
        h11 = g0 * r01 + g1 * r11 + g2 * r21
        h12 = g0 * r02 + g1 * r12 + g2 * r22
        g0, g1, g2 = g[6 * n + q], g[7 * n + q], g[8 * n + q]
        h20 = g0 * r00 + g1 * r10 + g2 * r20
        h21 = g0 * r01 + g1 * r11 + g2 * r21
        h22 = g0 * r02 + g1 * r12 + g2 * r22
        # Cofactors of h, and with them the growth of volume.
        c00, c01, c02 = h11 * h22 - h12 * h21, h12 * h20 - h10 * h22, h10 * h21 - h11 * h20
        c10, c11, c12 = h21 * h02 - h22 * h01, h22 * h00 - h20 * h02, h20 * h01 - h21 * h00
        c20, c21, c22 = h01 * h12 - h02 * h11, h02 * h10 - h00 * h12, h00 * h11 - h01 * h10
        trace = h00 + h11 + h22
        grown = trace + (c00 + c11 + c22) + (h00 * c00 + h01 * c01 + h02 * c02)
        growth[q] = grown
        square = h00 * h00 + h01 * h01 + h02 * h02 + h10 * h10 + h11 * h11 + h12 * h12
        distortion[q] = 2 * trace + square + h20 * h20 + h21 * h21 + h22 * h22
        # Stress mu (F - F^-T) + lambda (J - 1) cof F, where cof F = J F^-T = (1 + tr h) 1 - h^T + c
        # and F - F^-T = h + ((J - 1 - tr h) 1 + h^T - c) / J.
        mu = moduli[0, q]
        over = mu / (1 + grown)
        pull = moduli[1, q] * grown
        along = pull - over
        one = over * (grown - trace) + pull * (1 + trace)
        p00 = mu * h00 + along * (c00 - h00) + one
        p01 = mu * h01 + along * (c01 - h10)
        p02 = mu * h02 + along * (c02 - h20)
        p10 = mu * h10 + along * (c10 - h01)
        p11 = mu * h11 + along * (c11 - h11) + one
        p12 = mu * h12 + along * (c12 - h21)
        p20 = mu * h20 + along * (c20 - h02)
        p21 = mu * h21 + along * (c21 - h12)
        p22 = mu * h22 + along * (c22 - h22) + one
        g[q] = p00 * r00 + p01 * r01 + p02 * r02
        g[n + q] = p00 * r10 + p01 * r11 + p02 * r12
        g[2 * n + q] = p00 * r20 + p01 * r21 + p02 * r22
        g[3 * n + q] = p10 * r00 + p11 * r01 + p12 * r02
        g[4 * n + q] = p10 * r10 + p11 * r11 + p12 * r12
        g[5 * n + q] = p10 * r20 + p11 * r21 + p12 * r22
        g[6 * n + q] = p20 * r00 + p21 * r01 + p22 * r02
        g[7 * n + q] = p20 * r10 + p21 * r11 + p22 * r12
        g[8 * n + q] = p20 * r20 + p21 * r21 + p22 * r22


@kernel_part
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


@kernel_part
def _cofactor(h: NDArray[np.float64], c: NDArray[np.float64]) -> Any:
    """Cofactors of F = 1 + h, det(F) F^-T, from h and its own cofactors c."""
    return (1 + np.trace(h)) * np.eye(3) - h.T + c


@kernel_part
def _add_outer(factor: float, v: NDArray[np.float64], total: NDArray[np.float64]) -> None:
    """Add factor * v v^T."""
    for row in range(len(v)):
        scaled = factor * v[row]
        for col in range(len(v)):
            total[row, col] += scaled * v[col]


@kernel_part
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


@kernel
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
