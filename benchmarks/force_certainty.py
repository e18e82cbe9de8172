"""Whether the error bars are honest, and what noise alone looks like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from force_cases import LINEAR, ForceCase
from force_errors import NOISE_M, noisy, reconstructed
from numpy.typing import NDArray

from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured.force_field import ForceField

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
    def from_cases(cls, model: ForceModel, cases: Sequence[ForceCase], frames: int) -> ErrorBars:
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


@dataclass(frozen=True)
class Dependence:
    """Largest differences of a frame's wrench, in its deviations, that should change nothing.

    history: by where the recording begins.  pixel: by one corner, off by its noise in one frame,
    in that frame and those after it.
    """

    history: float
    pixel: float


def dependence(model: ForceModel, seeds: int = 4) -> Dependence:
    """Of a smooth hollow made by hand, which no elastic gel shows, that deepens and is dragged."""
    history, pixel = [0.0], [0.0]
    markers = model.elastic.markers
    distance2 = (markers.points**2).sum(axis=1).reshape(markers.rows, markers.cols, 1)
    for seed, width in ((seed, width) for seed in range(seeds) for width in (2e-3, 2.6e-3, 3.2e-3)):
        random = np.random.default_rng(seed)
        hollow = np.exp(-distance2 / (2 * width**2))
        deep = [hollow * [0.0, 0.0, -depth] for depth in np.linspace(1e-4, 1e-3, 10)]
        dragged = [hollow * [drag, 0.0, -1e-3] for drag in (2e-4, 4e-4)]
        frames = [
            moved + NOISE_M * random.standard_normal(moved.shape) for moved in (*deep, *dragged)
        ]
        model.reset()
        expected = reconstructed(model, frames)
        for start in range(1, len(frames)):
            model.reset()
            found = reconstructed(model, frames[start : start + 3])
            history += [_ratio(*pair) for pair in zip(found, expected[start:], strict=False)]
            spoilt = frames[start : start + 3]
            corner = tuple(
                random.integers(count // 4, 3 * count // 4) for count in hollow.shape[:2]
            )
            spoilt[0] = spoilt[0].copy()
            spoilt[0][corner] += NOISE_M * random.standard_normal(3)
            found = reconstructed(model, spoilt)
            pixel += [_ratio(*pair) for pair in zip(found, expected[start:], strict=False)]
    return Dependence(float(np.max(history)), float(np.max(pixel)))


def _ratio(field: ForceField, other: ForceField) -> float:
    std = np.minimum(field.wrench_std, other.wrench_std)
    return float(np.max(np.abs(field.wrench - other.wrench) / std))
