"""The elastomer block cut into hexahedra of second order: geometry, nodes, linear stiffness."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import PatternSurface

if TYPE_CHECKING:
    import skfem

# Below this share of the thickness at the apex the columns of elements under the block's
# corners are so flat that their shape spoils the solution.
MIN_THICKNESS_RATIO = 0.05
# From element to element of a thick block: the lowest ones carry its shear.
GENTLE_GROWTH = 1.35
# A node on the very edge of the block gets half a hat of this share of the spacing.
LEAST_REACH = 0.02

# Integration orders that give 3 x 3 x 3 and 2 x 2 x 2 points.  scikit-fem turns order 1 into 2
# silently, so what is under-integrated must be asked for as the points that it takes.
FULL_ORDER, REDUCED_ORDER = 5, 3


@dataclass(frozen=True)
class BlockGeometry:
    """An elastomer block, gel frame, m: centred in x and y, bonded at z = base.

    `surface` is the marker surface; the contact surface lies `layer` above it, along z.
    size: along x, y and from the base to the contact surface at the apex.
    """

    size: tuple[float, float, float]
    surface: PatternSurface
    layer: float

    @classmethod
    def from_sensor(cls, sensor: SensorDescription) -> BlockGeometry:
        """The block of a sensor; InputError where its surface reaches the base."""
        elastomer = sensor.elastomer
        block = cls(elastomer.size, sensor.pattern.surface, elastomer.shading_layer.thickness)
        block.check(sensor.name)
        return block

    @property
    def base(self) -> float:
        """Height z of the bonded base, m."""
        return self.layer - self.size[2]

    def contact_points(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (n, 3) m of the undeformed contact surface above points (n, 2) m."""
        return np.concatenate([xy, (self.surface.height(xy) + self.layer)[:, None]], axis=1)

    def surface_stretch(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Area of the contact surface per area seen along z, at points (..., 2) m."""
        step = 1e-6 * max(self.size)
        slope2 = np.zeros(xy.shape[:-1])
        for offset in (np.array([step, 0.0]), np.array([0.0, step])):
            rise = self.surface.height(xy + offset) - self.surface.height(xy - offset)
            slope2 += (rise / (2 * step)) ** 2
        return np.sqrt(1 + slope2)

    def check(self, name: str) -> None:
        """Raise InputError where the surface comes too near to the base to be a block."""
        corner = np.array([self.size[0] / 2, self.size[1] / 2])
        lowest = float(self.surface.height(corner)) - self.base
        needed = MIN_THICKNESS_RATIO * self.size[2]
        # Written so that NaN, a block wider than its sphere or cylinder, fails as well.
        if not lowest >= needed:
            found = (
                "a block wider than the surface's radius" if np.isnan(lowest) else f"{lowest:.3g} m"
            )
            msg = (
                f"{name}: elastomer.size and pattern.surface: thickness under the marker surface "
                f"at the block's corner: found {found}, expected at least {needed:.3g} m"
            )
            raise InputError(msg)


@dataclass(frozen=True)
class MeshDensity:
    """How fine the block is cut.

    With the defaults the displacement of the markers of a 22 x 22 x 6 mm block differs from that
    on a mesh of 28 elements across, 5, 8 and 2 by 0.05 % under a smooth patch of 3 mm radius and
    0.2 % under one of 1.5 mm; with 14 across it is 0.24 and 1.1 %. The width counts: 3 elements
    of depth instead of 4 change 0.04 %, another element of layer or rim less than 0.01 %.

    across: elements over the wider side of the loaded area, half of them on either side.
    rim: elements from the loaded area to the block's side, growing outwards.
    depth: elements from the base to the marker surface, growing downwards by `growth`; a thick
    block needs more, see `deep_enough`.  layer: elements in the shading layer.
    """

    across: int = 20
    rim: int = 3
    depth: int = 4
    layer: int = 1
    growth: float = 1.5

    def deep_enough(self, thickness: float, tallest: float) -> MeshDensity:
        """With more elements, growing less, where the uppermost were higher than `tallest`.

        thickness: of the body, m.  tallest: m.  Under a patch of 2.5 mm radius on a body of 30 mm
        4 elements that grow by 1.5 are too stiff by 0.4 % for a press and 1.3 % for a drag, 9 that
        grow by 1.35 by 0.1 and 0.3 %, measured on 11 that grow by 1.25.
        """
        depth, growth = self.depth, self.growth
        while thickness / np.sum(growth ** np.arange(depth)) > tallest:
            depth, growth = depth + 1, min(growth, GENTLE_GROWTH)
        return replace(self, depth=depth, growth=growth)


@dataclass(frozen=True)
class BlockMesh:
    """Hexahedra in vertical columns over a rectangle; nodes form a lattice twice as fine.

    x_edges, y_edges: element edges, ascending, m.  body, layer: heights of the element edges as
    a share of the body (base to marker surface) and of the shading layer, from 0 to 1.
    """

    geometry: BlockGeometry
    x_edges: NDArray[np.float64]
    y_edges: NDArray[np.float64]
    body: NDArray[np.float64]
    layer: NDArray[np.float64]

    @classmethod
    def quarter(
        cls, geometry: BlockGeometry, loaded: tuple[float, float], density: MeshDensity
    ) -> BlockMesh:
        """The quarter x >= 0, y >= 0, uniform up to the half-widths `loaded`, m."""
        step = 2 * max(loaded) / density.across
        halves = [
            graded_half_line(min(width, size / 2), size / 2, step, density.rim)
            for width, size in zip(loaded, geometry.size, strict=False)
        ]
        depth = np.concatenate([[0.0], np.cumsum(density.growth ** -np.arange(density.depth))])
        has_layer = geometry.layer > 0
        layer = np.linspace(0, 1, density.layer + 1) if has_layer else np.zeros(1)
        return cls(geometry, halves[0], halves[1], depth / depth[-1], layer)

    def mirrored(self) -> BlockMesh:
        """The whole block, of which this is the quarter."""
        x, y = (np.concatenate([-edges[:0:-1], edges]) for edges in (self.x_edges, self.y_edges))
        return replace(self, x_edges=x, y_edges=y)

    @property
    def elements(self) -> tuple[int, int, int]:
        """Numbers of elements along x, y and z."""
        up = len(self.body) + len(self.layer) - 2
        return len(self.x_edges) - 1, len(self.y_edges) - 1, up

    @property
    def lattice(self) -> tuple[int, int, int]:
        """Numbers of nodes along x, y and z."""
        nx, ny, nz = self.elements
        return 2 * nx + 1, 2 * ny + 1, 2 * nz + 1

    @property
    def marker_level(self) -> int:
        """Lattice level of the marker surface; the contact surface is the last level."""
        return 2 * (len(self.body) - 1)

    def element_nodes(self) -> NDArray[np.intp]:
        """Numbers (ix * ny + iy) * nz + iz of the lattice nodes of each element, (elements, 27).

        Elements and the nodes of each are in the order of their place, x first, z last.
        """
        lattice = np.arange(np.prod(self.lattice)).reshape(self.lattice)
        cubes = np.lib.stride_tricks.sliding_window_view(lattice, (3, 3, 3))[::2, ::2, ::2]
        return np.ascontiguousarray(cubes.reshape(-1, 27), dtype=np.intp)

    def is_layer(self) -> NDArray[np.bool_]:
        """Which elements lie in the shading layer, (elements,)."""
        nodes = self.element_nodes()
        return np.asarray((nodes % self.lattice[2] > self.marker_level).any(axis=1))

    def nodes(self) -> NDArray[np.float64]:
        """Positions of the lattice nodes, (nx, ny, nz, 3) m, gel frame."""
        x, y = np.meshgrid(_midpoints_added(self.x_edges), _midpoints_added(self.y_edges))
        xy = np.stack([x.T, y.T], axis=-1)
        height = self.geometry.surface.height(xy)[..., None]
        base = self.geometry.base
        body = base + _midpoints_added(self.body) * (height - base)
        layer = height + _midpoints_added(self.layer)[1:] * self.geometry.layer
        z = np.concatenate([body, layer], axis=-1)
        nodes = np.empty((*z.shape, 3))
        nodes[..., :2] = xy[:, :, None]
        nodes[..., 2] = z
        return nodes


def graded_half_line(inner: float, outer: float, step: float, rim: int) -> NDArray[np.float64]:
    """Element edges from 0 to `outer`: about `step` wide up to `inner`, growing beyond, m."""
    count = max(1, round(inner / step))
    edges = np.linspace(0, inner, count + 1)
    rest = outer - inner
    if rest <= 0.3 * step:
        return edges * (outer / inner)
    rim = min(rim, max(1, round(rest / step)))
    growth = _growth(rest * count / inner, rim)
    beyond = np.cumsum(growth ** np.arange(1, rim + 1))
    return np.concatenate([edges, inner + rest * beyond / beyond[-1]])


def _growth(length: float, count: int) -> float:
    """Factor g with g + g^2 + ... + g^count = length, at least 1."""
    low, high = 1.0, 10.0
    for _ in range(40):
        middle = (low + high) / 2
        too_long = np.sum(middle ** np.arange(1, count + 1)) > length
        low, high = (low, middle) if too_long else (middle, high)
    return low


def _midpoints_added(edges: NDArray[np.float64]) -> NDArray[np.float64]:
    line = np.empty(2 * len(edges) - 1)
    line[::2] = edges
    line[1::2] = (edges[1:] + edges[:-1]) / 2
    return line


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
    with one_thread():
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
