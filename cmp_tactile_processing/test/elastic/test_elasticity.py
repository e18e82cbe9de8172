"""The finite elements against closed forms, manufactured solutions and conservation laws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from cmp_tactile_processing.elastic.mesh import (
    BlockGeometry,
    BlockMesh,
    MeshDensity,
    hat_loads,
    interpolation,
    stiffness,
)
from cmp_tactile_processing.elastic.model import ElasticProblem, SurfaceGrid
from cmp_tactile_processing.sensor.parts import PatternSurface

PLANE = PatternSurface()
CAP = PatternSurface("sphere_cap", 0.027)
NEARLY_INCOMPRESSIBLE = (0.48, 0.4999)
COARSE = MeshDensity(across=4, rim=1, depth=1, layer=1)


def block(count, size=(0.02, 0.016, 0.006), surface=PLANE, layer=0.0) -> BlockMesh:
    """A whole block of count elements each way."""
    return BlockMesh(
        BlockGeometry(size, surface, layer),
        np.linspace(-size[0] / 2, size[0] / 2, count + 1),
        np.linspace(-size[1] / 2, size[1] / 2, count + 1),
        np.linspace(0, 1, count + 1),
        np.linspace(0, 1, 2) if layer else np.zeros(1),
    )


def held(matrix, fixed, values):
    """Displacement of all dofs where `fixed` (dofs,) bool take `values` (dofs,)."""
    moved = np.where(fixed, values, 0.0)
    free = np.flatnonzero(~fixed)
    moved[free] = spsolve(matrix[free][:, free].tocsc(), -(matrix @ moved)[free])
    return moved


def surface_of(mesh):
    """Dofs of the nodes on the block's whole surface, (dofs,) bool."""
    on = np.zeros((*mesh.lattice, 3), dtype=bool)
    for axis in range(3):
        for end in (0, -1):
            np.moveaxis(on, axis, 0)[end] = True
    return on.ravel()


@pytest.mark.parametrize("poisson", NEARLY_INCOMPRESSIBLE)
@pytest.mark.parametrize(("surface", "tolerance"), [(PLANE, 1e-9), (CAP, 2e-3)])
def test_a_linear_field_is_reproduced(poisson, surface, tolerance):
    """Patch test.  2 x 2 x 2 points are not exact on curved elements."""
    mesh = block(3, surface=surface)
    gradient = np.random.default_rng(1).normal(size=(3, 3))
    exact = (mesh.nodes() @ gradient.T).ravel()
    moved = held(stiffness(mesh, poisson), surface_of(mesh), exact)
    assert np.abs(moved - exact).max() < tolerance * np.abs(exact).max()


@pytest.mark.parametrize("poisson", NEARLY_INCOMPRESSIBLE)
def test_error_falls_with_the_third_order(poisson):
    """Manufactured solution grad(phi), phi harmonic: no body force, no change of volume.

    Second-order elements converge with order 3 in displacement, here 3.6 at the nodes; with the
    volume integrated in full it is 2.4 at 0.48 and 2.0 at 0.4999, with errors 40 times as large.
    """
    errors, counts = [], (3, 4, 6)
    for count in counts:
        mesh = block(count)
        x, y, z = np.moveaxis(mesh.nodes(), -1, 0)
        a, b = 300.0, 400.0
        c = np.hypot(a, b)
        exact = np.stack(
            [
                a * np.cos(a * x) * np.sin(b * y) * np.sinh(c * z),
                b * np.sin(a * x) * np.cos(b * y) * np.sinh(c * z),
                c * np.sin(a * x) * np.sin(b * y) * np.cosh(c * z),
            ],
            axis=-1,
        ).ravel()
        moved = held(stiffness(mesh, poisson), surface_of(mesh), exact)
        errors.append(np.sqrt(np.mean((moved - exact) ** 2) / np.mean(exact**2)))
    order = -np.polyfit(np.log2(counts), np.log2(errors), 1)[0]
    assert order > 3, errors


def test_wide_layer_is_compressed_as_in_one_dimension():
    """Uniform pressure on a wide thin layer: depth = p t / oedometer modulus, with any skin.

    Tests the chain of hats, mesh, elimination, mirror symmetry and observation at once.
    """
    poisson, pressure, body = 0.3, 1000.0, 1e-3
    grid = SurfaceGrid(11, 15, (0.014, 0.010))
    problem = ElasticProblem(
        BlockGeometry((0.02, 0.016, body + 2e-4), PLANE, 2e-4),
        poisson,
        3.0,
        SurfaceGrid(3, 5, (2e-3, 1e-3)),
        grid,
        MeshDensity(across=10, rim=2, depth=2, layer=1, growth=1.0),
    )
    forces = np.zeros((11 * 15, 3))
    forces[:, 2] = -pressure * grid.spacing[0] * grid.spacing[1]
    moved = problem.expand(problem.solve()) @ forces.ravel()
    modulus = (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    expected = np.tile([0, 0, -pressure * body / modulus], 15)
    # Five thicknesses inside the edge of the load it is still felt as 4e-3 in plane.
    assert np.abs(moved - expected).max() < 6e-3 * np.abs(expected).max()


@pytest.fixture(scope="module", params=["cap", "cylinder"])
def problem(request):
    surface = CAP if request.param == "cap" else PatternSurface("cylinder", 0.02, "x")
    geometry = BlockGeometry((0.022, 0.018, 0.006), surface, 3e-4)
    markers, nodes = SurfaceGrid(4, 5, (0.013, 0.012)), SurfaceGrid(3, 4, (0.013, 0.012))
    return ElasticProblem(geometry, 0.48, 2.0, markers, nodes, COARSE)


def whole_block(problem):
    """Stiffness, observers and loads of the block as a whole, base held: no mirror symmetry."""
    mesh = problem.mesh().mirrored()
    x, y = mesh.x_edges, mesh.y_edges

    def columns(level, x_line, y_line):
        out = np.zeros((*mesh.lattice, 3, len(x_line) * len(y_line), 3))
        factor = np.einsum("ib,ja->abij", y_line, x_line).reshape(*mesh.lattice[:2], -1)
        for component in range(3):
            out[:, :, level, component, :, component] = factor
        return out.reshape(3 * np.prod(mesh.lattice), -1)

    markers, nodes = problem.markers, problem.nodes
    observers = columns(mesh.marker_level, interpolation(x, markers.x), interpolation(y, markers.y))
    hats = columns(mesh.lattice[2] - 1, hat_loads(x, nodes.x).T, hat_loads(y, nodes.y).T)
    matrix = stiffness(mesh, problem.poisson, layer_young=problem.layer_ratio)
    free = np.arange(matrix.shape[0]) // 3 % mesh.lattice[2] != 0
    moved = np.zeros_like(hats)
    moved[free] = spsolve(matrix[free][:, free].tocsc(), sparse.csc_array(hats[free])).toarray()
    return mesh, matrix, observers, hats, moved


def test_quarter_block_stands_for_the_whole(problem):
    """Four mirror-symmetric parts, eliminated region by region, give what a direct solve gives."""
    _, _, observers, hats, moved = whole_block(problem)
    responses = problem.responses()
    found = problem.expand([part.markers for part in responses])
    at_nodes = replace(problem, markers=problem.nodes).expand([part.work for part in responses])
    for response, direct in ((found, observers.T @ moved), (at_nodes, hats.T @ moved)):
        assert np.abs(response - direct).max() < 1e-10 * np.abs(direct).max()


def test_base_carries_the_applied_forces_and_their_moments(problem):
    """Loads that lose force or lever arm between nodes and mesh, and wrong stiffness, show here."""
    mesh, matrix, _, _, moved = whole_block(problem)
    nodal = (matrix @ moved).reshape(*mesh.lattice, 3, -1)
    on_base = -nodal[:, :, 0].sum(axis=(0, 1))
    assert on_base == pytest.approx(np.tile(np.eye(3), (1, 12)), abs=1e-9)
    vertical = -nodal[:, :, 0, 2, 2::3]
    base = mesh.nodes()[:, :, 0]
    tangential = -nodal[:, :, 0, :2, 2::3]
    height = problem.geometry.base
    moment_x = np.tensordot(base[..., 1], vertical, 2) - height * tangential[:, :, 1].sum((0, 1))
    moment_y = height * tangential[:, :, 0].sum((0, 1)) - np.tensordot(base[..., 0], vertical, 2)
    assert moment_x == pytest.approx(problem.nodes.points[:, 1], abs=1e-9)
    assert moment_y == pytest.approx(-problem.nodes.points[:, 0], abs=1e-9)
