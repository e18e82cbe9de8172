"""Second-order elements: along a line, and the linear stiffness of a block of hexahedra."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.elastic.mesh import BlockMesh

if TYPE_CHECKING:
    import skfem

# A node on the very edge of the block gets half a hat of this share of the spacing.
LEAST_REACH = 0.02

# Integration orders that give 3 x 3 x 3 and 2 x 2 x 2 points.  scikit-fem turns order 1 into 2
# silently, so what is under-integrated must be asked for as the points that it takes.
FULL_ORDER, REDUCED_ORDER = 5, 3


def interpolation(edges: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (points, 2 elements + 1) that interpolates nodal values at `at`, inside the line."""
    element = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
    t = (at - edges[element]) / (edges[element + 1] - edges[element])
    matrix = np.zeros((len(at), 2 * len(edges) - 1))
    rows = np.arange(len(at))
    matrix[rows, 2 * element] = (1 - t) * (1 - 2 * t)
    matrix[rows, 2 * element + 1] = 4 * t * (1 - t)
    matrix[rows, 2 * element + 2] = t * (2 * t - 1)
    return matrix


def interpolation_slope(edges: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix (points, 2 elements + 1) from nodal values to the slope at `at`, inside the line."""
    element = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, len(edges) - 2)
    width = edges[element + 1] - edges[element]
    t = (at - edges[element]) / width
    matrix = np.zeros((len(at), 2 * len(edges) - 1))
    rows = np.arange(len(at))
    matrix[rows, 2 * element] = (4 * t - 3) / width
    matrix[rows, 2 * element + 1] = (4 - 8 * t) / width
    matrix[rows, 2 * element + 2] = (4 * t - 1) / width
    return matrix


def hat_loads(edges: NDArray[np.float64], nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Consistent nodal loads (2 elements + 1, nodes) of unit forces spread as hats over the nodes.

    A hat reaches one spacing to either side of its node, less where the line ends before that.
    The integrals are exact: each column sums to 1 and has its node as centroid.
    """
    spacing = nodes[1] - nodes[0]
    room = np.minimum(nodes - edges[0], edges[-1] - nodes)
    reach = np.clip(room, LEAST_REACH * spacing, spacing)
    breaks = np.concatenate([edges, nodes, nodes - reach, nodes + reach])
    breaks = np.unique(np.clip(breaks, edges[0], edges[-1]))
    gauss, gauss_weights = np.polynomial.legendre.leggauss(2)
    half = np.diff(breaks)[:, None] / 2
    points = ((breaks[:-1, None] + half) + half * gauss).ravel()
    weights = (half * gauss_weights).ravel()
    hats = np.maximum(0, 1 - np.abs(points[:, None] - nodes) / reach)
    loads = interpolation(edges, points).T @ (weights[:, None] * hats)
    return np.asarray(loads / loads.sum(axis=0))


def fold(matrix: NDArray[np.float64], sign: int) -> NDArray[np.float64]:
    """Columns of nodes at +x and -x joined: acts on values at x >= 0 of an even or odd function."""
    middle = matrix.shape[1] // 2
    folded: NDArray[np.float64] = matrix[:, middle:].copy()
    folded[:, 1:] += sign * matrix[:, middle - 1 :: -1]
    if sign < 0:
        folded[:, 0] = 0
    return folded


def stiffness(
    mesh: BlockMesh, poisson: float, young: float = 1.0, layer_young: float = 1.0
) -> sparse.csr_array:
    """Stiffness matrix of all nodes, none held; unit N/m for moduli in Pa.

    Degree of freedom 3 n + c is component c of lattice node n = (ix * ny + iy) * nz + iz.
    """
    return assembled(element_stiffness(mesh, poisson, young, layer_young), mesh.element_nodes())


def element_stiffness(
    mesh: BlockMesh, poisson: float, young: float = 1.0, layer_young: float = 1.0
) -> NDArray[np.float64]:
    """Stiffness matrix of each element, (elements, 81, 81); N/m for moduli in Pa.

    Selective reduced integration: the volumetric term on 2 x 2 x 2 points, the shear term on
    3 x 3 x 3, so that the 27-node element does not lock as `poisson` nears 0.5.
    """
    fem, lattice = _second_order_mesh(mesh)
    gradients, weights = _point_tables(fem, lattice, FULL_ORDER)
    reduced_gradients, reduced_weights = _point_tables(fem, lattice, REDUCED_ORDER)
    modulus = np.where(mesh.is_layer(), layer_young, young)
    shear = modulus / (2 * (1 + poisson))
    bulk = modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))
    # One thread for the many small products: more would wait for one another on loaded cores.
    with one_blas_thread():
        local = _shear_term(gradients, weights * shear[:, None])
        local += _volume_term(reduced_gradients, reduced_weights * bulk[:, None])
    return local


def assembled(local: NDArray[np.float64], nodes: NDArray[np.intp]) -> sparse.csr_array:
    """The matrix of all nodes, of elements (elements, 81, 81) with nodes (elements, 27)."""
    dofs = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    rows = np.broadcast_to(dofs[:, :, None], local.shape).ravel()
    cols = np.broadcast_to(dofs[:, None, :], local.shape).ravel()
    count = 3 * (int(nodes.max()) + 1)
    return sparse.coo_array((local.ravel(), (rows, cols)), shape=(count, count)).tocsr()


def _second_order_mesh(mesh: BlockMesh) -> tuple[skfem.MeshHex2, NDArray[np.intp]]:
    """The mesh for scikit-fem, and the lattice node of each of its nodes."""
    import skfem  # long to import for what a cache spares

    steps = [np.arange(count + 1, dtype=np.float64) for count in mesh.elements]
    unit = skfem.MeshHex2.from_mesh(skfem.MeshHex.init_tensor(*steps))
    ix, iy, iz = np.rint(2 * unit.doflocs).astype(np.intp)
    lattice = np.ravel_multi_index((ix, iy, iz), mesh.lattice)
    points = mesh.nodes().reshape(-1, 3)[lattice]
    return replace(unit, doflocs=np.ascontiguousarray(points.T)), lattice


def _point_tables(
    fem: skfem.MeshHex2, lattice: NDArray[np.intp], order: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shape gradients and weights of all integration points, in the order of element_nodes.

    Shapes (points, elements, 27, 3) 1/m and (elements, points) m^3.
    """
    import skfem

    basis = skfem.Basis(fem, skfem.ElementHex2(), intorder=order)
    gradients = np.stack([np.asarray(shape[0].grad) for shape in basis.basis])
    nodes = lattice[basis.element_dofs].T
    elements, shapes = np.argsort(nodes.min(axis=1)), np.argsort(nodes, axis=1)
    gradients = np.take_along_axis(
        np.transpose(gradients, (3, 2, 0, 1)), shapes[None, :, :, None], axis=2
    )
    return gradients[:, elements], basis.dx[elements]


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
