#!/usr/bin/env python3
"""Building the elastomer's compliance: our elimination against cholespy and SciPy's SuperLU.

All three get the same quarter block with the same loads and observers, and one thread each.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import cholespy
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.elastic.block_elimination import Block, inverse_product
from cmp_tactile_processing.sensor.library import load_sensor
from cmp_tactile_simulation.gel.contact_problem import ContactProblem

# Right-hand sides that are solved at once by the solvers that take a matrix of them.
CHUNK = 128

Products = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class System:
    """The equations, and the blocks of our elimination."""

    matrix: sparse.csr_array
    observers: sparse.csc_array
    loads: sparse.csc_array
    blocks: list[Block]


@dataclass(frozen=True)
class Result:
    """Seconds, megabytes above what the equations themselves take, and the products."""

    seconds: float
    megabytes: float
    products: Products


def ours(system: System) -> Products:
    """Nested dissection with dense blocks that carries loads and observers along."""
    return inverse_product(system.matrix, system.blocks, system.observers, system.loads)


def with_cholespy(system: System) -> Products:
    """CHOLMOD's sparse Cholesky factor by cholespy."""
    csc = system.matrix.tocsc()
    csc.sort_indices()
    solver = cholespy.CholeskySolverD(
        csc.shape[0],
        csc.indptr.astype(np.int32),
        csc.indices.astype(np.int32),
        csc.data,
        cholespy.MatrixType.CSC,
    )

    def solve(loads: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = np.zeros_like(loads)
        solver.solve(loads, moved)
        return moved

    return _products(system, solve)


def with_superlu(system: System) -> Products:
    """SuperLU in its mode for symmetric matrices, by SciPy."""
    factor = splu(
        system.matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return _products(system, factor.solve)


SOLVERS: dict[str, Callable[[System], Products]] = {
    "ours": ours,
    "cholespy": with_cholespy,
    "SuperLU": with_superlu,
}


def _products(
    system: System, solve: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> Products:
    seen, work = [], []
    for start in range(0, system.loads.shape[1], CHUNK):
        moved = solve(np.ascontiguousarray(system.loads[:, start : start + CHUNK].toarray()))
        seen.append(system.observers.T @ moved)
        work.append(system.loads.T @ moved)
    return np.hstack(seen), np.hstack(work)


def _measure(name: str, folder: Path) -> Result:
    """One solver in a process of its own, whose peak of memory is the solver's."""
    matrix, observers, loads = (
        sparse.load_npz(folder / f"{part}.npz") for part in ("matrix", "observers", "loads")
    )
    table = np.load(folder / "blocks.npz", allow_pickle=False)["blocks"]
    blocks = [
        Block(start, stop, tuple(child for child in children if child >= 0))
        for start, stop, *children in table.tolist()
    ]
    system = System(matrix, observers, loads, blocks)
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


def _write_system(folder: Path, problem: ContactProblem) -> tuple[int, int, int]:
    """The first parity's equations as files; numbers of unknowns, loads and observers."""
    _, system = next(problem.systems())
    for part in ("matrix", "observers", "loads"):
        sparse.save_npz(folder / f"{part}.npz", getattr(system, part), compressed=False)
    table = [(block.start, block.stop, *(block.children or (-1, -1))) for block in system.blocks]
    np.savez(folder / "blocks.npz", blocks=np.array(table))
    return system.matrix.shape[0], system.loads.shape[1], system.observers.shape[1]


def main() -> None:
    """Build the equations, let each solver have them, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="prototype", help="name or file (default: prototype)")
    parser.add_argument("--nodes", type=int, default=28, help="contact nodes (default: 28)")
    arguments = parser.parse_args()
    sensor = load_sensor(arguments.sensor)
    problem = ContactProblem.with_nodes(sensor, arguments.nodes)
    with tempfile.TemporaryDirectory() as folder:
        unknowns, loads, observers = _write_system(Path(folder), problem)
        print(
            f"quarter of {sensor.name}: {unknowns} unknowns, {loads} loads, {observers} observers"
        )
        context = multiprocessing.get_context("spawn")
        results = {}
        for name in SOLVERS:
            with context.Pool(1) as pool:
                results[name] = pool.apply(_measure, (name, Path(folder)))
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
