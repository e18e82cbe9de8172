"""Stiffness of a block of second-order hexahedra that does not lock near incompressibility."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import skfem
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.elastic.elastomer_mesh import BlockMesh

__all__ = [
    "FULL_ORDER",
    "REDUCED_ORDER",
    "point_tables",
    "second_order_mesh",
    "stiffness",
]

# Integration orders that give 3 x 3 x 3 and 2 x 2 x 2 points.  scikit-fem turns order 1 into 2
# without a word, so what is under-integrated must be asked for as the points that it takes.
FULL_ORDER, REDUCED_ORDER = 5, 3


def stiffness(
    mesh: BlockMesh, poisson: float, young: float = 1.0, layer_young: float = 1.0
) -> sparse.csr_array:
    """Stiffness matrix of all nodes, none held; unit N/m for moduli in Pa.

    Degree of freedom 3 n + c is component c of lattice node n = (ix * ny + iy) * nz + iz.
    Selective reduced integration: the volumetric term on 2 x 2 x 2 points, the shear term on
    3 x 3 x 3, so that the 27-node element does not lock as `poisson` nears 0.5.
    """
    fem, lattice = second_order_mesh(mesh)
    element_nodes, gradients, weights = point_tables(fem, FULL_ORDER)
    _, reduced_gradients, reduced_weights = point_tables(fem, REDUCED_ORDER)
    nodes = lattice[element_nodes]
    above = nodes % mesh.lattice[2] > mesh.marker_level
    modulus = np.where(above.any(axis=0), layer_young, young)
    shear = modulus / (2 * (1 + poisson))
    bulk = modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))
    # One thread for the many small products: more would wait for one another on loaded cores.
    with threadpool_limits(1):
        local = _shear_term(gradients, weights * shear[:, None])
        local += _volume_term(reduced_gradients, reduced_weights * bulk[:, None])
    return _assemble(local, nodes.T, len(lattice))


def second_order_mesh(mesh: BlockMesh) -> tuple[skfem.MeshHex2, NDArray[np.intp]]:
    """The mesh for scikit-fem, and the lattice node of each of its nodes."""
    steps = [np.arange(count + 1, dtype=np.float64) for count in mesh.elements]
    unit = skfem.MeshHex2.from_mesh(skfem.MeshHex.init_tensor(*steps))
    ix, iy, iz = np.rint(2 * unit.doflocs).astype(np.intp)
    lattice = np.ravel_multi_index((ix, iy, iz), mesh.lattice)
    points = mesh.nodes().reshape(-1, 3)[lattice]
    return replace(unit, doflocs=np.ascontiguousarray(points.T)), lattice


def point_tables(
    fem: skfem.MeshHex2, order: int
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Nodes, shape gradients and weights of all integration points.

    Shapes (27, elements), (points, elements, 27, 3) 1/m and (elements, points) m^3.
    """
    basis = skfem.Basis(fem, skfem.ElementHex2(), intorder=order)
    gradients = np.stack([np.asarray(shape[0].grad) for shape in basis.basis])
    return basis.element_dofs, np.transpose(gradients, (3, 2, 0, 1)), basis.dx


def _shear_term(
    gradients: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Integral of 2 mu eps(u) : eps(v) per element, (elements, 81, 81); weights: with mu."""
    points, count, shapes = gradients.shape[:3]
    by_element = gradients.swapaxes(0, 1)
    # Rows whose squares add up to 2 eps : eps, as 2 eps_cd = u_c,d + u_d,c counts for cd and dc.
    strain = np.zeros((count, points, 6, shapes, 3))
    for c in range(3):
        strain[:, :, c, :, c] = np.sqrt(2) * by_element[..., c]
        d = (c + 1) % 3
        strain[:, :, 3 + c, :, c] = by_element[..., d]
        strain[:, :, 3 + c, :, d] = by_element[..., c]
    strain *= np.sqrt(weights)[:, :, None, None, None]
    flat = strain.reshape(count, 6 * points, 3 * shapes)
    return np.asarray(flat.swapaxes(1, 2) @ flat)


def _volume_term(
    gradients: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Integral of lambda div(u) div(v) per element, (elements, 81, 81)."""
    divergence = gradients.reshape(*gradients.shape[:2], -1).swapaxes(0, 1)
    return np.asarray(divergence.swapaxes(1, 2) @ (divergence * weights[:, :, None]))


def _assemble(
    local: NDArray[np.float64], nodes: NDArray[np.intp], node_count: int
) -> sparse.csr_array:
    dofs = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    rows = np.broadcast_to(dofs[:, :, None], local.shape).ravel()
    cols = np.broadcast_to(dofs[:, None, :], local.shape).ravel()
    shape = (3 * node_count, 3 * node_count)
    return sparse.coo_array((local.ravel(), (rows, cols)), shape=shape).tocsr()
