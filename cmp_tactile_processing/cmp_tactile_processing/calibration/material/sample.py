"""What a material calibration is given: how the gel looks under a load that is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.measured.grid import Status
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["LoadSample", "check_samples", "sample_name", "strain_corrected"]


def _unknown() -> NDArray[np.float64]:
    return np.full(3, np.nan)


@dataclass(frozen=True)
class LoadSample:
    """Displacement of the markers, of one frame or averaged over some, under a known load.

    displacement (rows, cols, 3) m and status (rows, cols) as ForceModel takes them.
    force (3,) N: on the gel, gel frame, so that a press has negative z; NaN in components that are
    not known.  std (3,) N: standard deviations of its known components.
    torque (3,) N m: moment on the gel about the gel frame's origin, with torque_std (3,).
    name: how findings call it, such as "200 g"; its number where empty.
    """

    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]
    force: NDArray[np.float64]
    std: NDArray[np.float64]
    torque: NDArray[np.float64] = field(default_factory=_unknown)
    torque_std: NDArray[np.float64] = field(default_factory=_unknown)
    name: str = ""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the load's marker displacements are known, (rows, cols, 3)."""
        seen = np.asarray(self.status) != Status.MISSING
        return np.asarray(np.isfinite(self.displacement) & seen[..., None])

    @property
    def reference(self) -> NDArray[np.float64]:
        """Force and torque, (6,) N and N m."""
        return np.concatenate([self.force, self.torque]).astype(np.float64)

    @property
    def reference_std(self) -> NDArray[np.float64]:
        """Standard deviations of `reference`, (6,)."""
        return np.concatenate([self.std, self.torque_std]).astype(np.float64)


def sample_name(samples: Sequence[LoadSample], index: int) -> str:
    """How people are told of a sample: "load 2", "load 3 (200 g)"."""
    name = samples[index].name
    return f"load {index + 1} ({name})" if name else f"load {index + 1}"


def strain_corrected(sensor: SensorDescription) -> bool:
    """Whether ForceModel takes out what large strain does to this gel."""
    choice = sensor.force.large_press
    return choice == "on" or (choice == "auto" and sensor.elastomer.model == "neo_hookean")


def check_samples(sensor: SensorDescription, samples: Sequence[LoadSample]) -> None:
    """Raise CalibrationError for samples that cannot be of this sensor, or that tell no load."""
    if not samples:
        msg = f"{sensor.name}: samples: found none, expected at least one known load"
        raise CalibrationError(msg)
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    shapes = {"displacement": (rows, cols, 3), "status": (rows, cols)}
    shapes |= dict.fromkeys(("force", "std", "torque", "torque_std"), (3,))
    for index, sample in enumerate(samples):
        where = f"{sensor.name}: {sample_name(samples, index)}"
        for key, expected in shapes.items():
            found = np.shape(getattr(sample, key))
            if found != expected:
                msg = f"{where}: {key}: found shape {found}, expected {expected}"
                raise CalibrationError(msg)
        _check_reference(where, sample)


def _check_reference(where: str, sample: LoadSample) -> None:
    for key, std_key in (("force", "std"), ("torque", "torque_std")):
        value, std = np.asarray(getattr(sample, key)), np.asarray(getattr(sample, std_key))
        if np.isinf(value).any():
            msg = f"{where}: {key}: found {_text(value)}, expected numbers, or NaN where not known"
            raise CalibrationError(msg)
        known = np.isfinite(value)
        if not (np.isfinite(std[known]) & (std[known] > 0)).all():
            msg = (
                f"{where}: {std_key}: found {_text(std)}, expected a number above 0 for every "
                f"known component of {key} {_text(value)}"
            )
            raise CalibrationError(msg)
    if not np.isfinite(sample.force).any():
        msg = f"{where}: force: found {_text(sample.force)}, expected one known component or more"
        raise CalibrationError(msg)


def _text(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"
