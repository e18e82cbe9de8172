"""The condensed elastomer against a direct solution of the whole block, and what it promises."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from cmp_tactile_processing.elastic.elastomer_mesh import BlockMesh
from cmp_tactile_processing.elastic.quadratic_line import hat_loads, interpolation
from cmp_tactile_processing.elastic.stiffness import stiffness
from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.gel.contact_problem import ContactProblem
from cmp_tactile_simulation.gel.linear_elastomer import LinearElastomer

# Two ways of solving the same equations differ by what the condition of the matrix makes of
# rounding, some 1e-12.
SAME = 1e-9


@dataclass(frozen=True)
class WholeBlock:
    """The block without mirror symmetry, E = 1 Pa: response to unit forces on all nodes."""

    mesh: BlockMesh
    of_nodes: NDArray[np.float64]
    of_markers: NDArray[np.float64]
    on_base: NDArray[np.float64]

    @classmethod
    def from_problem(cls, problem: ContactProblem) -> WholeBlock:
        mesh = problem.mesh().mirrored()
        x, y = mesh.x_edges, mesh.y_edges

        def columns(level, x_line, y_line):
            out = np.zeros((*mesh.lattice, 3, len(x_line) * len(y_line), 3))
            factor = np.einsum("ib,ja->abij", y_line, x_line).reshape(*mesh.lattice[:2], -1)
            for component in range(3):
                out[:, :, level, component, :, component] = factor
            return out.reshape(3 * np.prod(mesh.lattice), -1)

        markers, nodes = problem.markers, problem.nodes
        seen = columns(mesh.marker_level, interpolation(x, markers.x), interpolation(y, markers.y))
        hats = columns(mesh.lattice[2] - 1, hat_loads(x, nodes.x).T, hat_loads(y, nodes.y).T)
        matrix = stiffness(mesh, problem.poisson, layer_young=problem.layer_ratio)
        free = np.arange(matrix.shape[0]) // 3 % mesh.lattice[2] != 0
        moved = np.zeros_like(hats)
        held = splu(matrix[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0)
        moved[free] = held.solve(hats[free])
        on_base = (matrix[~free] @ moved).reshape(*mesh.lattice[:2], 3, -1)
        return cls(mesh, hats.T @ moved, seen.T @ moved, on_base)


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((PatternSurface(), 3e-4, 6), id="plane with skin, even nodes"),
        pytest.param((PatternSurface("sphere_cap", 0.015), 0.0, 6), id="cap without skin"),
        pytest.param((PatternSurface("sphere_cap", 0.015), 3e-4, 7), id="cap, odd nodes"),
        pytest.param((PatternSurface("cylinder", 0.012, "x"), 3e-4, 5), id="cylinder along x"),
        pytest.param((PatternSurface("cylinder", 0.012, "y"), 0.0, 5), id="cylinder along y"),
    ],
)
def case(request, gel):
    """A sensor, a number of nodes, and its block solved as a whole."""
    surface, layer, nodes = request.param
    sensor = gel(surface, layer)
    return sensor, nodes, WholeBlock.from_problem(ContactProblem.with_nodes(sensor, nodes))


def test_stands_for_the_whole_block(case, tmp_path):
    """Lost symmetry, hats off their place, a wrong level or a wrong gather all show here."""
    sensor, nodes, whole = case
    found = LinearElastomer(sensor, nodes, tmp_path)
    young, count = sensor.elastomer.young, found.nodes.rows * found.nodes.cols
    compliance = found.compliance(np.arange(count))
    assert np.abs(compliance * young - whole.of_nodes).max() < SAME * np.abs(whole.of_nodes).max()
    some = np.random.default_rng(1).permutation(count)[: count // 2]
    dofs = (3 * some[:, None] + np.arange(3)).ravel()
    assert np.array_equal(found.compliance(some), compliance[np.ix_(dofs, dofs)])
    force = np.random.default_rng(2).normal(size=(count, 3))
    moved = whole.of_nodes @ force.ravel() / young
    markers = whole.of_markers @ force.ravel() / young
    found_markers = found.marker_displacement(force)
    assert found_markers.shape == (found.observers.rows, found.observers.cols, 3)
    assert np.abs(found.displacement(force).ravel() - moved).max() < SAME * np.abs(moved).max()
    assert np.abs(found_markers.ravel() - markers).max() < SAME * np.abs(markers).max()


def test_base_carries_the_applied_force_and_moment(case):
    """Within 0.1 %; equilibrium of the discrete equations is exact but for rounding.

    Of moments those of the normal forces: a hat lies on the curved surface, so that the mean
    height at which a horizontal force acts is not the node's.
    """
    sensor, nodes, whole = case
    points = ContactProblem.with_nodes(sensor, nodes).nodes.points
    force = -whole.on_base.sum(axis=(0, 1))
    assert force == pytest.approx(np.tile(np.eye(3), len(points)), abs=1e-3)
    base = whole.mesh.nodes()[:, :, 0]
    moment = np.cross(base[:, :, None], -np.moveaxis(whole.on_base[..., 2::3], 2, 3))
    expected = np.stack([points[:, 1], -points[:, 0], np.zeros(len(points))], axis=1)
    assert np.abs(moment.sum(axis=(0, 1)) - expected).max() < 1e-3 * np.abs(points).max()


def test_compliance_is_symmetric_and_positive_definite(elastomer):
    """Newton's method on the contact, and its energy, rest on it; mind the rim and the axes."""
    compliance = elastomer.compliance(np.arange(elastomer.nodes.rows * elastomer.nodes.cols))
    assert np.abs(compliance - compliance.T).max() <= 1e-10 * np.abs(compliance).max()
    values = np.linalg.eigvalsh(compliance)
    # Elements wider than the nodes' distance cannot tell all nodes apart: then this is 1e-17.
    assert values[0] > 1e-4 * values[-1]


def test_forces_do_work(elastomer):
    force = np.random.default_rng(4).normal(
        size=(20, elastomer.nodes.rows * elastomer.nodes.cols, 3)
    )
    assert all(np.sum(one * elastomer.displacement(one)) > 0 for one in force)


def test_mirrored_forces_give_mirrored_displacements(elastomer):
    rows, cols = elastomer.nodes.rows, elastomer.nodes.cols
    force = np.random.default_rng(6).normal(size=(rows, cols, 3))
    moved = elastomer.marker_displacement(force.reshape(-1, 3))
    for axis, component in ((1, 0), (0, 1)):
        turn = np.where(np.arange(3) == component, -1, 1)
        mirrored = elastomer.marker_displacement((np.flip(force, axis) * turn).reshape(-1, 3))
        difference = mirrored - np.flip(moved, axis) * turn
        assert np.abs(difference).max() < SAME * np.abs(moved).max()


def test_neighbours_are_equally_stiff(gel, tmp_path):
    """A mesh that lies differently under neighbours makes ripples of 2 %.

    Compliance grows smoothly towards the sides; the fourth difference is blind to that, and makes
    16 times a ripple's amplitude of it.
    """
    found = LinearElastomer(gel(PatternSurface()), 20, tmp_path)
    rows, cols = found.nodes.rows, found.nodes.cols
    middle = np.arange(rows * cols).reshape(rows, cols)[rows // 2, 2:-2]
    diagonal = np.diag(found.compliance(middle)).reshape(-1, 3)
    ripple = np.diff(diagonal, 4, axis=0) / 16 / diagonal[2:-2]
    assert np.abs(ripple).max() < 1e-3, ripple


def test_nodes_lie_on_the_contact_surface(elastomer, gel):
    position, radius, layer = elastomer.node_position, 0.015, 3e-4
    from_centre = position - [0, 0, layer - radius]
    np.testing.assert_allclose(np.linalg.norm(from_centre, axis=1), radius, rtol=1e-12)
    cap = elastomer.node_area.reshape(elastomer.nodes.rows, elastomer.nodes.cols)
    # Of a cap the area under a cell is its projection over the cosine of its slope.
    cell = np.prod(elastomer.nodes.spacing)
    cosine = from_centre[:, 2] / radius
    np.testing.assert_allclose(cap.ravel(), cell / cosine, rtol=1e-6)


def test_built_once_for_any_stiffness(gel, tmp_path, caplog):
    """Compliance goes with 1 / E; the number of nodes and the ratio of the moduli ask for more."""
    caplog.set_level(logging.INFO, "cmp_tactile_simulation")
    sensor, told = gel(), []
    first = LinearElastomer(sensor, 5, tmp_path, lambda _, done: told.append(done))
    assert "building the elastomer of sphere_cap_13x9" in caplog.text
    assert told == sorted(told)
    assert told[-1] == 1
    caplog.clear()
    skin = replace(sensor.elastomer.shading_layer, young=2 * sensor.elastomer.shading_layer.young)
    stiff = replace(sensor.elastomer, young=2 * sensor.elastomer.young, shading_layer=skin)
    second = LinearElastomer(replace(sensor, elastomer=stiff), 5, tmp_path)
    assert not caplog.records
    active = np.arange(4)
    np.testing.assert_allclose(second.compliance(active) * 2, first.compliance(active), rtol=1e-12)
    LinearElastomer(sensor, 6, tmp_path)
    LinearElastomer(
        replace(sensor, elastomer=replace(stiff, shading_layer=replace(skin, young=1e5))),
        5,
        tmp_path,
    )
    assert len(list(tmp_path.iterdir())) == 3


def test_force_of_a_wrong_shape_is_an_error(elastomer):
    with pytest.raises(SimulationError, match=r"force: found shape \(99,\), expected \(99, 3\)"):
        elastomer.displacement(np.zeros(99))
    with pytest.raises(SimulationError, match=r"expected \(99, 3\)"):
        elastomer.marker_displacement(np.zeros((98, 3)))


def test_surface_that_reaches_the_base_is_an_error(gel, tmp_path):
    with pytest.raises(GeometryError, match=r"elastomer.size and pattern.surface"):
        LinearElastomer(gel(PatternSurface("sphere_cap", 0.0062)), 6, tmp_path)
