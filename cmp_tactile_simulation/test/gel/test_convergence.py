"""How the elastomer's displacement nears its limit as the mesh is refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from cmp_tactile_processing.elastic.mesh import BlockGeometry, MeshDensity
from cmp_tactile_processing.measured import SurfaceGrid
from cmp_tactile_processing.sensor.parts import PatternSurface
from cmp_tactile_simulation.gel import ContactProblem

PLANE, CAP = PatternSurface(), PatternSurface("sphere_cap", 40.0)

# Refinements: so many elements to a half of each side of the first mesh.
HALVES = (2, 3, 4)


def smooth_loads(nodes):
    """Nodal forces (3 nodes, 2): a smooth bump that presses, and one that pushes along x."""
    x, y = (nodes.points / (np.array(nodes.extent) + 2 * np.array(nodes.spacing))).T
    bump = np.cos(np.pi * x) ** 2 * np.cos(np.pi * y) ** 2
    forces = np.zeros((len(bump), 3, 2))
    forces[:, 2, 0] = -bump / bump.sum()
    forces[:, 0, 1] = bump / bump.sum()
    return forces.reshape(-1, 2)


def work_of(problem):
    """Load times its own displacement, (2,): twice the energy of either load."""
    responses = problem.responses(smooth_loads(problem.nodes))
    return np.diag(sum(response.work for response in responses))


def observed_order(counts, values):
    """The p of value(h) = limit - C h^p that three meshes of h = 1 / count show."""
    first, second, third = 1 / np.asarray(counts, dtype=np.float64)
    ratio = (values[1] - values[0]) / (values[2] - values[1])
    return brentq(lambda p: (first**p - second**p) / (second**p - third**p) - ratio, 0.1, 9)


@pytest.mark.parametrize(("surface", "poisson"), [(PLANE, 0.48), (CAP, 0.4999)])
def test_energy_converges_with_order_three(surface, poisson, record_property):
    """Second-order elements: order 4 in energy where the solution is smooth; observed 2.8 to 3.4.

    The kinks of the loads' hats and the edges where the bonded base meets the free sides cost
    the rest.  First-order elements have order 2, elements that lock hardly any on such meshes.
    """
    block = BlockGeometry((16.0, 16.0, 2.0), surface, 0.0)
    nodes = SurfaceGrid(3, 3, (2.0, 2.0))
    works = []
    for half in HALVES:
        density = MeshDensity(2 * half, rim=2 * half, depth=half, growth=1.0)
        works.append(work_of(ContactProblem(block, poisson, 1.0, nodes, nodes, density)))
    for name, values in zip(("press", "push"), np.transpose(works), strict=True):
        assert (np.diff(values) > 0).all(), "a coarser mesh is stiffer"
        order = observed_order(HALVES, values)
        record_property(f"order_{name}", order)
        assert order > 2.5


@pytest.mark.parametrize("layer", [3e-4, 0.0])
def test_nearly_incompressible_gel_does_not_lock(gel, layer):
    """Stiffness within 0.5 % of that on a mesh twice as fine, itself within 0.2 % of a finer one.

    The same holds at 0.48.  With the volume integrated in full the gel is 5 to 6 % too stiff.
    """
    problem = ContactProblem.with_nodes(gel(layer=layer, poisson=0.4999), 8)
    density = problem.density
    fine = replace(
        density,
        across=2 * density.across,
        rim=2 * density.rim,
        depth=density.depth + 2,
        layer=2,
        growth=1.5,
    )
    works = [work_of(replace(problem, density=choice)) for choice in (density, fine)]
    np.testing.assert_allclose(works[0] / works[1], 1, atol=5e-3)
