"""Compiled loops over the elements of `neo_hookean`: nodal forces and tangent stiffness."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "FULL",
    "POINTS",
    "REDUCED",
    "SHAPES",
    "FlatPoints",
    "PointTable",
    "add_force",
    "add_tangent",
]

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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def add_force(
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
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
def add_tangent(
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
