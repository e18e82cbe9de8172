"""What the force stage shows of the loads with a material, against what the loads are.

The fit has an inverse of its own.  What counts in the end is what ForceModel shows, which goes with
Young's modulus, so the modulus is set by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.sample import LoadSample
from cmp_tactile_processing.force.resultant import material_covariance
from cmp_tactile_processing.measured.force_field import ForceField

__all__ = ["Readings", "force_std"]

# Components of a load below this share of it tell no relative error.
LEAST_SHARE = 0.1


@dataclass(frozen=True)
class Readings:
    """Forces that ForceModel shows of some loads, of a modulus that may still be changed.

    shown, reference (n, 3) N: the reference without its offset, NaN where not known.  std (n, 3) N:
    of their difference, from the reference and the noise of the markers.
    """

    shown: NDArray[np.float64]
    reference: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def from_samples(
        cls,
        samples: Sequence[LoadSample],
        fields: Sequence[ForceField],
        offset: NDArray[np.float64],
        factor: float = 1.0,
    ) -> Readings:
        """Of samples and their fields; factor: of the modulus since these were made."""
        return cls(
            shown=factor * np.array([field.wrench[:3] for field in fields]),
            reference=np.array([sample.force for sample in samples]) - np.nan_to_num(offset[:3]),
            std=np.hypot(
                np.array([sample.std for sample in samples]),
                factor * np.array([field.wrench_std[:3] for field in fields]),
            ),
        )

    def scale(self, model_error: float) -> float:
        """By what the modulus is to be multiplied for the loads to be shown right on the whole.

        The larger component of a load tells most, mostly the normal one.
        """
        size = np.linalg.norm(np.nan_to_num(self.reference), axis=1, keepdims=True)
        weight = np.nan_to_num(1 / (self.std**2 + (model_error * size) ** 2))
        told = np.nan_to_num(self.reference)
        return float((weight * self.shown * told).sum() / (weight * self.shown**2).sum())

    def spread(self, scale: float) -> tuple[float, float]:
        """Relative deviations of normal and tangential force from one load to another.

        Without what `std` explains; 0 where no load tells them.
        """
        off = scale * self.shown - self.reference
        size = np.linalg.norm(np.nan_to_num(self.reference), axis=1)
        parts = []
        # One of the normal forces is as good as used up: the modulus makes it right.
        for axes, used in ((slice(2, 3), 1), (slice(0, 2), 0)):
            known = np.isfinite(self.reference[:, axes]).all(axis=1)
            force = np.linalg.norm(self.reference[known, axes], axis=1)
            large = force > LEAST_SHARE * size[known]
            relative = (off[known, axes] ** 2 - self.std[known, axes] ** 2).sum(axis=1)[large]
            count = int(large.sum()) - used
            total = float((relative / force[large] ** 2).sum())
            parts.append(np.sqrt(max(0.0, total) / count) if count > 0 else 0.0)
        return float(parts[0]), float(parts[1])


def force_std(
    field: ForceField, factor: float, normal: float, tangential: float
) -> NDArray[np.float64]:
    """Deviations (3,) of the force of a field made without a calibration record, N.

    factor: of the modulus since; normal, tangential: relative deviations that the record adds.
    """
    wrench = factor * field.wrench
    covariance = factor**2 * field.wrench_covariance
    covariance = covariance + material_covariance(wrench, np.zeros(3), normal, tangential)
    return np.asarray(np.sqrt(np.diag(covariance)[:3]))
