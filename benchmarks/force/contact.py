#!/usr/bin/env python3
"""Contact with friction: our Newton's method against projected Gauss-Seidel and SciPy's nnls.

The paper's sphere of 15 mm (section IV.D) on the prototype's dome with E = 2 MPa and friction 0.6:
one step of 0.2 mm of a deep press, and the whole way from touching to 50 N, 12 N and 50 N mm.
Gauss-Seidel solves the same step; nnls knows no friction, and gets a linear problem with the
normals and gaps of our solution.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.contact.indentation import ContactSimulation
from cmp_tactile_simulation.contact.laws import (
    ContactState,
    Load,
    Pose,
    Problem,
    View,
    law_residual,
    look,
)
from cmp_tactile_simulation.gel import LinearElastomer
from cmp_tactile_simulation.indenters.shapes import Sphere

Array = NDArray[np.float64]

YOUNG, RADIUS, FRICTION = 2e6, 0.015, 0.6
PAPER_LOAD = Load(50.0, (12.0, 0.0), 0.05)
STEP = 2e-4
# Nodes nearer to the sphere than this, m, are in the peers' problems.
NEAR = 1e-4
# Gauss-Seidel ends, as ours does, where no node misses the laws by more than this, m.
TOLERANCE = 1e-10
SWEEPS_AT_ONCE, MAX_SWEEPS = 5, 20_000


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=40, help="contact nodes along a side")
    parser.add_argument("--steps", type=int, default=5, help="repetitions of a step")
    arguments = parser.parse_args()
    gel = prototype(arguments.nodes)
    with threadpool_limits(1):
        rows = [
            *step_rows(gel, FRICTION, arguments.steps, gauss_seidel_step),
            *step_rows(gel, 0.0, arguments.steps, nnls_step),
            *paper_load_rows(gel),
        ]
    print(f"{'':58}{'seconds':>9}{'ratio':>8}{'force differs':>15}")
    for name, seconds, ratio, difference in rows:
        print(f"{name:58}{seconds:9.3f}{ratio:>8}{difference:>15}")


def prototype(nodes: int) -> LinearElastomer:
    """The paper's prototype of a material that bears the paper's load."""
    sensor = load_sensor("prototype")
    layer = replace(sensor.elastomer.shading_layer, young=YOUNG)
    elastomer = replace(sensor.elastomer, young=YOUNG, shading_layer=layer)
    return LinearElastomer(replace(sensor, elastomer=elastomer), nodes)


def step_rows(
    gel: LinearElastomer, friction: float, count: int, peer: Callable[..., tuple[str, Array]]
) -> list[tuple[str, float, str, str]]:
    """One warm step, and the peer on the same step."""
    simulation = ContactSimulation(gel, Sphere(RADIUS), friction)
    before = touching(simulation)
    before = simulation.move(before, down(before, 6 * STEP))
    after = simulation.move(before, down(before, STEP))
    ours = timed(lambda: simulation.move(before, down(before, STEP)), count)
    name, force = peer(before, after, friction, gel)
    theirs = timed(lambda: peer(before, after, friction, gel), 1)
    difference = np.abs(force - after.force).max() / np.abs(after.force).max()
    nodes = int(after.contact.sum())
    return [
        (f"step to {nodes} touching nodes, friction {friction:g}, ours", ours, "1", ""),
        (f"  {name}", theirs, f"{theirs / ours:.1f}", f"{difference:.0e}"),
    ]


def paper_load_rows(gel: LinearElastomer) -> list[tuple[str, float, str, str]]:
    """The whole way to the paper's load, in steps of ours."""
    simulation = ContactSimulation(gel, Sphere(RADIUS), FRICTION)
    start = touching(simulation)
    seconds = timed(lambda: simulation.press(start, PAPER_LOAD), 2)
    return [("from touching to 50 N, 12 N, 50 N mm, ours", seconds, "", "")]


def touching(simulation: ContactSimulation) -> ContactState:
    """The sphere on the apex."""
    return simulation.rest(simulation.touch(Pose()))


def down(state: ContactState, depth: float) -> Pose:
    """The pose that much deeper."""
    return Pose(state.pose.position - (0, 0, depth), state.pose.rotation)


def timed(run: Callable[[], Any], count: int) -> float:
    """Median seconds of a run."""
    times = []
    for _ in range(count):
        begin = perf_counter()
        run()
        times.append(perf_counter() - begin)
    return median(times)


def step_problem(
    before: ContactState, after: ContactState, friction: float, gel: LinearElastomer
) -> tuple[NDArray[np.intp], Problem, View]:
    """The nodes that may touch, their problem, and our solution of it."""
    nodes = np.flatnonzero(after.contact | (after.gap < NEAR))
    rest = gel.node_position[nodes]
    problem = Problem(
        compliance=gel.compliance(nodes),
        nodes=np.arange(len(nodes)),
        rest=rest,
        before=rest + before.displacement[nodes],
        before_pose=before.pose,
        touched=before.contact[nodes],
        indenter=Sphere(RADIUS),
        friction=friction,
    )
    return nodes, problem, look(problem, rest, after.force[nodes], after.pose)


def relative(problem: Problem, view: View) -> Array:
    """Where the nodes would be without force, from where the linearised laws hold, (k, 3) m."""
    return problem.rest - view.place + view.gap[:, None] * view.normal + view.slip


def gauss_seidel_step(
    before: ContactState, after: ContactState, friction: float, gel: LinearElastomer
) -> tuple[str, Array]:
    """The same step by plain projected Gauss-Seidel, compiled, from zero force.

    Like ours it takes normals and gaps where the nodes are, again after some sweeps.
    """
    nodes, problem, _ = step_problem(before, after, friction, gel)
    force = np.zeros_like(problem.rest)
    sweeps, residual = 0, np.inf
    while residual > TOLERANCE and sweeps < MAX_SWEEPS:
        view = look(problem, problem.rest, force, after.pose)
        residual = max(part.max() for part in law_residual(problem, view))
        gauss_seidel(problem.compliance, force, relative(problem, view), view.normal, friction)
        sweeps += SWEEPS_AT_ONCE
    whole = np.zeros_like(after.force)
    whole[nodes] = force
    return f"projected Gauss-Seidel from zero, {sweeps} sweeps", whole


@njit(cache=True)
def gauss_seidel(
    compliance: Array, force: Array, excess: Array, normal: Array, friction: float
) -> None:
    """Sweep over `force` (k, 3), in place."""
    for _ in range(SWEEPS_AT_ONCE):
        for i in range(len(force)):
            own = 0.0
            place = excess[i].copy()
            for c in range(3):
                place[c] += np.dot(compliance[3 * i + c], force.ravel())
                own = max(own, compliance[3 * i + c, 3 * i + c])
            trial = force[i] - place / own
            pressing = max(0.0, np.dot(trial, normal[i]))
            along = trial - np.dot(trial, normal[i]) * normal[i]
            size = np.sqrt(np.dot(along, along))
            if size > friction * pressing:
                along *= friction * pressing / size
            force[i] = pressing * normal[i] + along


def nnls_step(
    before: ContactState, after: ContactState, friction: float, gel: LinearElastomer
) -> tuple[str, Array]:
    """Normal forces alone, min f'Cf / 2 + gap f with f >= 0, as least squares."""
    nodes, problem, view = step_problem(before, after, friction, gel)
    excess = relative(problem, view)
    count = len(nodes)
    blocks = problem.compliance.reshape(count, 3, count, 3)
    matrix = np.einsum("ia,iajb,jb->ij", view.normal, blocks, view.normal, optimize=True)
    gap = (excess * view.normal).sum(axis=1)
    factor = cholesky((matrix + matrix.T) / 2, lower=True)
    scale = np.abs(factor).max()
    pressing, _ = nnls(
        factor.T / scale, -solve_triangular(factor, gap, lower=True) / scale, maxiter=100 * count
    )
    whole = np.zeros_like(after.force)
    whole[nodes] = pressing[:, None] * view.normal
    return "scipy.optimize.nnls", whole


if __name__ == "__main__":
    main()
