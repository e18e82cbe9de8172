"""Time of a frame's force on one core, of building and loading the model, and its size on disk.

Times are the processor's, which other work on the machine changes less.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np
from force_cases import ForceCase
from force_errors import NOISE_M, noisy
from force_sweeps import large_press_models
from numpy.typing import NDArray
from scipy import sparse
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.traction_prior import (
    TANGENTIAL_SHARE,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.force.traction_spectrum import TractionSpectrum
from cmp_tactile_processing.measured.grid import Status
from cmp_tactile_processing.sensor.description import SensorDescription

REPEATS = 300


@dataclass(frozen=True)
class Speed:
    """Shortest times of many frames, ms; s and MB of the model.  NaN: not available.

    first_ms: of the first pass by itself; one_pass_ms: of a frame with that pass alone, contacts
    and error bars included.
    """

    first_ms: float
    one_pass_ms: float
    rest_ms: float
    two_pass_ms: float
    corrected_ms: float
    build_s: float
    load_s: float
    cache_mb: float


def measure_speed(sensor: SensorDescription, cases: Sequence[ForceCase]) -> Speed:
    """Times of the sphere at 5 N; the corrected model's of a frame much like the one before."""
    case = next(case for case in cases if case.name == "sphere" and case.newton == 5.0)
    moved = noisy(case, 1)[0]
    noise = replace(case, displacement=np.zeros_like(moved))
    with threadpool_limits(1), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = process_time()
        both = ForceModel(sensor, folder)
        build = process_time() - start
        size = sum(path.stat().st_size for path in folder.rglob("*")) / 1e6
        load = _shortest(lambda: ForceModel(sensor, folder), 5)
        one = replace(sensor, force=replace(sensor.force, two_pass=False))
        single = ForceModel(one, folder)
        return Speed(
            first_ms=1e3 * _first_pass_time(both, sensor, moved),
            one_pass_ms=1e3 * _frame_time(single, moved),
            rest_ms=1e3 * _frame_time(both, noisy(noise, 1)[0]),
            two_pass_ms=1e3 * _frame_time(both, moved),
            corrected_ms=1e3 * _corrected_time(sensor, moved),
            build_s=build,
            load_s=load,
            cache_mb=size,
        )


def _first_pass_time(
    model: ForceModel, sensor: SensorDescription, moved: NDArray[np.float64]
) -> float:
    """What the force model does first with every frame, made of the same parts."""
    nodes, markers = model.elastic.nodes, model.elastic.markers
    components = np.diag([TANGENTIAL_SHARE**-2, TANGENTIAL_SHARE**-2, 1.0])
    precision = np.kron(smoothness(nodes, sensor.force.smoothing_length), components)
    nodal = sparse.csr_array(np.kron(nodal_force_matrix(nodes), np.eye(3)))
    noise = np.tile(NOISE_M, markers.rows * markers.cols)
    response = model.elastic.compliance / noise[:, None]
    spectrum = TractionSpectrum(markers, nodes, response, precision, nodal)
    data, known = moved.ravel() / noise, np.ones(moved.size, dtype=bool)
    return _shortest(lambda: spectrum.solve(data, known), REPEATS)


def _corrected_time(sensor: SensorDescription, moved: NDArray[np.float64]) -> float:
    model = large_press_models(sensor)["corrected"]
    seen = np.full(moved.shape[:2], Status.MEASURED, dtype=np.uint8)
    # A third of the load: about as deep as the correction is meant for.
    if not model.reconstruct(moved / 3, seen).corrected:
        return float("nan")
    return _frame_time(model, moved / 3, 20)


def _frame_time(model: ForceModel, moved: NDArray[np.float64], repeats: int = REPEATS) -> float:
    seen = np.full(moved.shape[:2], Status.MEASURED, dtype=np.uint8)
    return _shortest(lambda: model.reconstruct(moved, seen), repeats)


def _shortest(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = process_time()
        work()
        times.append(process_time() - start)
    return min(times)
