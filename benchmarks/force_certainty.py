"""Whether the error bars are honest, and what noise alone looks like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from force_cases import LINEAR, ForceCase
from force_errors import NOISE_M, noisy, reconstructed
from numpy.typing import NDArray

from cmp_tactile_processing.force import ForceModel

Array = NDArray[np.float64]

COMPONENTS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
# Of a normal distribution, within 1 and 2 standard deviations.
NORMAL_SHARES = (0.683, 0.954)
SMALL_LOADS_N = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)


@dataclass(frozen=True)
class ErrorBars:
    """Errors in units of the standard deviations that were told.

    wrench: (frames, 6).  nodes: (values,) of all components of nodes where force truly acts.
    loads: (frames,) N.
    """

    wrench: Array
    nodes: Array
    loads: Array

    @classmethod
    def of(cls, model: ForceModel, cases: Sequence[ForceCase], frames: int) -> ErrorBars:
        """Of contacts at every load that was solved."""
        wrench, nodes, loads = [], [], []
        for case in cases:
            if case.material != LINEAR or case.newton > 10:
                continue
            acts = case.force_on_nodes[:, 2] < -0.02 * np.abs(case.force_on_nodes[:, 2]).max()
            for field in reconstructed(model, noisy(case, frames)):
                wrench.append((field.wrench - case.wrench) / field.wrench_std)
                loads.append(case.newton)
                if field.force_std is not None:
                    off = (field.force - case.force_on_nodes)[acts]
                    std = field.force_std[acts]
                    nodes.append((off[std > 0] / std[std > 0]).ravel())
        joined = np.concatenate(nodes) if nodes else np.zeros(0)
        return cls(np.array(wrench), joined, np.array(loads))

    def shares(self, values: Array) -> tuple[float, float]:
        """Share of errors within 1 and within 2 standard deviations."""
        size = np.abs(values)
        return float((size <= 1).mean()), float((size <= 2).mean())


@dataclass(frozen=True)
class Floor:
    """Frames of noise alone, by multiple of the noise: how many, and those that showed contact."""

    scale: float
    frames: int
    contacts: int


def floor(model: ForceModel, frames: int, scale: float) -> Floor:
    """Frames of noise alone."""
    random = np.random.default_rng(99)
    markers = model.elastic.markers
    shape = (markers.rows, markers.cols, 3)
    shown = 0
    for _ in range(frames):
        moved = scale * NOISE_M * random.standard_normal(shape)
        shown += bool(reconstructed(model, [moved])[0].contact.any())
    return Floor(scale, frames, shown)


def seen_shares(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> dict[float, float]:
    """Share of frames in which the sphere is seen at all, by load, N.

    Below 0.2 N the displacement is that of 0.2 N on a linear gel times the load.
    """
    smallest = min(
        (case for case in cases if case.name == "sphere" and case.material == LINEAR),
        key=lambda case: case.newton,
    )
    found = {}
    for newton in SMALL_LOADS_N:
        factor = newton / smallest.newton
        case = replace(smallest, newton=newton, displacement=factor * smallest.displacement)
        fields = reconstructed(model, noisy(case, frames))
        found[newton] = float(np.mean([field.contact.any() for field in fields]))
    return found
