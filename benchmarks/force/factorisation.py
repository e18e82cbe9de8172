#!/usr/bin/env python3
"""Building the elastomer's compliance: our elimination against SciPy's SuperLU.

Both get the same quarter block with the same loads and observers, and one thread each.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.elastic.mesh import assembled
from cmp_tactile_processing.elastic.model import QuarterSystem
from cmp_tactile_processing.sensor.description import load_sensor
from cmp_tactile_simulation.gel import ContactProblem

# Right-hand sides that are solved at once by the solver that takes a matrix of them.
CHUNK = 128

Products = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class System:
    """The equations, and their assembled matrix, observers and loads of the free unknowns."""

    quarter: QuarterSystem
    matrix: sparse.csc_array
    observers: sparse.csc_array
    loads: sparse.csc_array


@dataclass(frozen=True)
class Result:
    """Seconds, megabytes above what the equations themselves take, and the products."""

    seconds: float
    megabytes: float
    products: Products


def ours(system: System) -> Products:
    """Nested dissection with dense blocks that carries loads and observers along."""
    response = system.quarter.respond()
    return response.markers, response.work


def with_superlu(system: System) -> Products:
    """SuperLU in its mode for symmetric matrices, by SciPy."""
    factor = splu(
        system.matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    seen, work = [], []
    for start in range(0, system.loads.shape[1], CHUNK):
        loads = np.ascontiguousarray(system.loads[:, start : start + CHUNK].toarray())
        moved = factor.solve(loads)
        seen.append(system.observers.T @ moved)
        work.append(system.loads.T @ moved)
    return np.hstack(seen), np.hstack(work)


SOLVERS: dict[str, Callable[[System], Products]] = {"ours": ours, "SuperLU": with_superlu}


def _measure(name: str, system: System) -> Result:
    """One solver in a process of its own, whose peak of memory is the solver's."""
    # What is compiled is compiled before.
    SOLVERS[name](_first_system(ContactProblem.with_nodes(load_sensor("prototype"), 5)))
    before = _peak_megabytes()
    with threadpool_limits(1):
        start = perf_counter()
        products = SOLVERS[name](system)
        seconds = perf_counter() - start
    return Result(seconds, _peak_megabytes() - before, products)


def _peak_megabytes() -> float:
    """Largest memory of this process so far; ru_maxrss would count the parent's as well."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    line = next(line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1024


def _first_system(problem: ContactProblem) -> System:
    """The first parity's equations."""
    parity, quarter = next(problem.systems())
    mesh = problem.mesh()
    free = np.flatnonzero(parity.free(mesh.lattice))
    matrix = assembled(quarter.stiffness, mesh.element_nodes())[free][:, free].tocsc()
    observers, loads = (part.tocsr()[free].tocsc() for part in (quarter.observers, quarter.loads))
    return System(quarter, matrix, observers, loads)


def main() -> None:
    """Build the equations, let each solver have them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="prototype", help="name or file (default: prototype)")
    parser.add_argument("--nodes", type=int, default=28, help="contact nodes (default: 28)")
    arguments = parser.parse_args()
    sensor = load_sensor(arguments.sensor)
    system = _first_system(ContactProblem.with_nodes(sensor, arguments.nodes))
    print(
        f"quarter of {sensor.name}: {system.matrix.shape[0]} unknowns, "
        f"{system.loads.shape[1]} loads, {system.observers.shape[1]} observers"
    )
    context = multiprocessing.get_context("spawn")
    results = {}
    for name in SOLVERS:
        with context.Pool(1) as pool:
            results[name] = pool.apply(_measure, (name, system))
    _print_table(results)


def _print_table(results: dict[str, Result]) -> None:
    reference = results["ours"]
    print(f"{'solver':<10}{'time s':>9}{'ratio':>8}{'memory MB':>11}{'ratio':>8}{'difference':>13}")
    for name, result in results.items():
        difference = max(
            np.abs(found - expected).max() / np.abs(expected).max()
            for found, expected in zip(result.products, reference.products, strict=True)
        )
        print(
            f"{name:<10}{result.seconds:>9.2f}{result.seconds / reference.seconds:>8.1f}"
            f"{result.megabytes:>11.0f}{result.megabytes / reference.megabytes:>8.1f}"
            f"{difference:>13.1e}"
        )


if __name__ == "__main__":
    main()
