#!/usr/bin/env python3
"""The neo-Hookean gel: one Newton iteration against general solvers, a press against the linear.

The factors are of the same tangent stiffness, of the stretched gel, with one thread each. The
press brings a sphere 1 mm into the gel. Times are the processor's, which other work on the
machine changes less.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import perf_counter, process_time

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.elastic.cholesky import Dissection
from cmp_tactile_processing.elastic.mesh import assembled
from cmp_tactile_processing.elastic.neo_hookean import NeoHookeanElements
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import Pose
from cmp_tactile_simulation.gel import LinearElastomer, NeoHookeanElastomer
from cmp_tactile_simulation.indenters.shapes import Sphere

RADIUS, DEPTH, FRICTION = 7.5e-3, 1e-3, 0.6


def main() -> None:
    """Measure and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="prototype", help="name or file (default: prototype)")
    parser.add_argument("--nodes", type=int, default=40, help="contact nodes (default: 40)")
    parser.add_argument("--repeat", type=int, default=3, help="the best of (default: 3)")
    arguments = parser.parse_args()
    sensor = load_sensor(arguments.sensor)
    linear = LinearElastomer(sensor, arguments.nodes)
    start = perf_counter()
    neo = NeoHookeanElastomer(sensor, arguments.nodes)
    print(f"elastomer ready in {perf_counter() - start:.1f} s, compliance from the cache")
    with threadpool_limits(1):
        _compare_factors(sensor, neo, arguments.repeat)
    _compare_presses(linear, neo)


def _compare_factors(sensor: SensorDescription, neo: NeoHookeanElastomer, repeat: int) -> None:
    material, mesh = sensor.elastomer, neo.mesh
    elements = NeoHookeanElements.from_mesh(
        mesh, material.poisson, material.young, material.shading_layer.young
    )
    dissection = Dissection(mesh.lattice, elements.nodes)
    moved = 0.02 * (mesh.nodes().reshape(-1, 3) - [0, 0, mesh.geometry.base]) * [0, 0, 1]
    tangent = elements.tangent(moved)
    matrix = _assembled(elements, tangent, mesh.lattice[2])
    load = np.random.default_rng(0).normal(size=matrix.shape[0])
    factor, superlu = dissection.factor(tangent), _superlu(matrix)
    whole_load = np.zeros(3 * elements.node_count)
    ours = _best(lambda: dissection.factor(tangent), repeat)
    rows = {
        "energy and forces": _best(lambda: elements.equilibrium(moved), repeat),
        "tangent stiffness": _best(lambda: elements.tangent(moved), repeat),
        "factor, ours": ours,
        "factor, SuperLU": _best(lambda: _superlu(matrix), 1),
        "solve, ours": _best(lambda: factor.solve(whole_load), repeat),
        "solve, SuperLU": _best(lambda: superlu.solve(load), repeat),
    }
    count = "x".join(str(number) for number in mesh.elements)
    print(f"\n{count} elements, {matrix.shape[0]} unknowns{'cpu s':>15}{'ratio':>8}")
    for name, seconds in rows.items():
        print(f"{name:<36}{seconds:>10.3f}{seconds / ours:>8.2f}")


def _compare_presses(linear: LinearElastomer, neo: NeoHookeanElastomer) -> None:
    print(f"\n{'press of 1 mm':<20}{'cpu s':>10}{'ratio':>8}{'force N':>10}{'factors':>9}")
    reference = 0.0
    for name, elastomer in (("linear", linear), ("neo-Hookean", neo)):
        contact = ContactSimulation(elastomer, Sphere(RADIUS), FRICTION)
        state = contact.rest(contact.touch(Pose(np.array([0, 0, 2 * RADIUS]))))
        below = Pose(state.pose.position - [0, 0, DEPTH])
        contact.move(state, Pose(state.pose.position - [0, 0, DEPTH / 10]))
        factors, start = neo.factorisations, process_time()
        with threadpool_limits(1):
            state = contact.move(state, below)
        seconds = process_time() - start
        reference = reference or seconds
        force, factors = -state.resultant[2], neo.factorisations - factors
        print(f"{name:<20}{seconds:>10.2f}{seconds / reference:>8.1f}{force:>10.3f}{factors:>9}")


def _assembled(
    elements: NeoHookeanElements, tangent: NDArray[np.float64], height: int
) -> sparse.csc_array:
    """The free part of the matrix, as general solvers take it."""
    matrix = assembled(tangent, elements.nodes)
    free = np.arange(matrix.shape[0]) // 3 % height != 0
    matrix = matrix[free][:, free].tocsc()
    matrix.sort_indices()
    return matrix


def _superlu(matrix: sparse.csc_array) -> SuperLU:
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _best(work: Callable[[], object], repeat: int) -> float:
    times = []
    for _ in range(repeat):
        start = process_time()
        work()
        times.append(process_time() - start)
    return min(times)


if __name__ == "__main__":
    main()
