"""The gel under large strains, and the gel that a description asks for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.elastic.equilibrium import NewtonEquilibrium
from cmp_tactile_processing.elastic.mesh import (
    BlockGeometry,
    BlockMesh,
    MeshDensity,
    hat_loads,
    interpolation,
)
from cmp_tactile_processing.elastic.model import mesh_under
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.errors import ContactError, NotConvergedError
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.processes import OnProgress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.gel import LinearElastomer, RelaxingElastomer

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Mesh on which the gel is followed to large strain.  A sphere of 7.5 mm pressed 1 mm into 6 mm of
# gel meets the same force, to 0.02 %, on a mesh with 20 elements across and 4 deep, and markers
# move as there to 0.4 um RMS, 4 um at most, of the 70 um that large strain adds.
DENSITY = MeshDensity(across=16, rim=1, depth=3, growth=2.0)

# What the contact solver and the renderer load and observe.
Elastomer = LinearElastomer | RelaxingElastomer


class NeoHookeanElastomer(LinearElastomer):
    """The gel of a sensor under large strain: an `Elastomer` of material `neo_hookean`.

    What is linear in the load comes from the fine mesh of LinearElastomer, and what large
    strain changes from a coarser one of the whole block:

        u(f) = u_linear, fine(f) + (u_neo-Hookean, coarse(f) - u_linear, coarse(f))

    The coarse mesh, which has to be factorised for every larger change of the load, so need not
    resolve single contact nodes, small loads give the linear gel to all digits, and the
    displacement still is the derivative of an energy.

    Loads are dead: forces keep direction and size while the surface moves. Each displacement
    is sought from the latest one on; it depends on the way there by 1e-7 of itself.

    A dead pressure of some two shear moduli makes a soft surface fold. A sphere of 5 mm is
    followed 1.4 mm deep into 6 mm of gel, the corner of a cube 0.7 mm; beyond, ContactError.

    nodes, cache_dir, progress: as LinearElastomer takes them, and with its errors.
    mesh: the coarse mesh.
    """

    softens = True

    def __init__(
        self,
        sensor: SensorDescription,
        nodes: int = 40,
        cache_dir: Path | None = None,
        progress: OnProgress | None = None,
        density: MeshDensity = DENSITY,
    ) -> None:
        super().__init__(sensor, nodes, cache_dir, progress)
        self.mesh = mesh = _whole_mesh(sensor, self.nodes, density)
        material = sensor.elastomer
        elements = NeoHookeanElements.from_mesh(
            mesh, material.poisson, material.young, material.shading_layer.young
        )
        with one_thread():
            self._block = NewtonEquilibrium(mesh, elements)
        self._hats = (
            hat_loads(mesh.x_edges, self.nodes.x),
            hat_loads(mesh.y_edges, self.nodes.y),
        )
        self._views = (
            interpolation(mesh.x_edges, self.observers.x),
            interpolation(mesh.y_edges, self.observers.y),
        )
        self._rest = np.zeros(0, dtype=np.intp), np.zeros((0, 0))

    @property
    def factorisations(self) -> int:
        """How many times the tangent stiffness has been factorised so far."""
        return self._block.factorisations

    def compliance(self, active: Index) -> Array:
        """Change of the active nodes' displacement with their forces, (3 k, 3 k) m/N.

        At the latest displacement that was asked for, to within a Newton step; symmetric.  Row
        and column 3 a + c is component c of active[a].
        """
        compliance = super().compliance(active)
        factor = self._block.tangent_factor
        if factor is self._block.factor_at_rest:
            return compliance
        with one_thread():
            loads = self._unit_loads(active)
            compliance += factor.compliance(loads)
            compliance -= self._coarse_at_rest(active, loads)
        return compliance

    def displacement(self, force: Array) -> Array:
        """Displacement of the contact nodes (N, 3) m under nodal forces (N, 3) N.

        Raises ContactError where the material cannot follow.
        """
        linear = super().displacement(force)
        top = self._beyond_linear(force)[:, :, -1]
        x, y = self._hats
        beyond: Array = np.einsum("xj,yi,xyc->ijc", x, y, top, optimize=True)
        return linear + beyond.reshape(-1, 3)

    def marker_displacement(self, force: Array) -> Array:
        """Displacement of the marker surface at the observers, (rows, cols, 3) m.

        Raises ContactError where the material cannot follow.
        """
        linear = super().marker_displacement(force)
        level = self._beyond_linear(force)[:, :, self.mesh.marker_level]
        x, y = self._views
        beyond: Array = np.einsum("jx,iy,xyc->ijc", x, y, level, optimize=True)
        return linear + beyond

    def _beyond_linear(self, force: Array) -> Array:
        """What large strain adds on the lattice of the coarse mesh, (nx, ny, nz, 3) m."""
        x, y = self._hats
        force = np.reshape(force, (self.nodes.rows, self.nodes.cols, 3))
        load = np.zeros((*self.mesh.lattice, 3))
        load[:, :, -1] = np.einsum("xj,yi,ijc->xyc", x, y, force, optimize=True)
        with one_thread():
            try:
                moved = self._block.move_to(load.reshape(-1, 3))
            except NotConvergedError as error:
                raise ContactError(str(error)) from None
            linear = self._block.factor_at_rest.solve(load.ravel())
        return np.asarray((moved - linear.reshape(-1, 3)).reshape(load.shape))

    def _coarse_at_rest(self, active: Index, loads: sparse.csr_array) -> Array:
        """The coarse mesh's own compliance at rest, remembered for the nodes asked for last."""
        if not np.array_equal(active, self._rest[0]):
            self._rest = active.copy(), self._block.factor_at_rest.compliance(loads)
        return self._rest[1]

    def _unit_loads(self, active: Index) -> sparse.csr_array:
        """Unit forces on the active nodes, (unknowns, 3 k)."""
        nx, ny, nz = self.mesh.lattice
        i, j = np.divmod(active, self.nodes.cols)
        x, y = self._hats
        ix, iy, k = np.nonzero((x[:, None, j] != 0) & (y[None, :, i] != 0))
        entries = x[ix, j[k]] * y[iy, i[k]]
        rows = 3 * ((ix * ny + iy) * nz + nz - 1)[:, None] + np.arange(3)
        cols = 3 * k[:, None] + np.arange(3)
        data = np.repeat(entries, 3), (rows.ravel(), cols.ravel())
        return sparse.coo_array(data, shape=(3 * nx * ny * nz, 3 * len(active))).tocsr()


def _whole_mesh(sensor: SensorDescription, nodes: SurfaceGrid, density: MeshDensity) -> BlockMesh:
    """The whole block, uniform under the hats of the contact nodes."""
    geometry = BlockGeometry.from_sensor(sensor)
    if geometry.layer == 0:
        density = replace(density, depth=density.depth + 1)
    return mesh_under(nodes, geometry, density).mirrored()


def elastomer_of(
    sensor: SensorDescription,
    nodes: int = 40,
    cache_dir: Path | None = None,
    progress: OnProgress | None = None,
) -> Elastomer:
    """The gel of a sensor: the material that `elastomer.model` names, with `elastomer.relaxation`.

    nodes: contact nodes along the longer side of the contact patch.
    cache_dir, progress: where the compliance is kept, and who hears how far it is built.
    Raises what the elastomer itself raises.
    """
    is_linear = sensor.elastomer.model == "linear"
    model = LinearElastomer if is_linear else NeoHookeanElastomer
    elastic = model(sensor, nodes, cache_dir, progress)
    relaxation = sensor.elastomer.relaxation
    return elastic if relaxation is None else RelaxingElastomer(elastic, relaxation)
