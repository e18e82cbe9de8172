"""How uncertain forces are because the material is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily
from cmp_tactile_processing.calibration.material.fit import Load, MaterialFit

__all__ = ["force_deviations"]


def force_deviations(
    family: ComplianceFamily, loads: Sequence[Load], fit: MaterialFit
) -> tuple[float, float]:
    """Relative standard deviations of normal and tangential force computed with this material.

    They follow from how wrong modulus and shape can be together: a Poisson's ratio that is too low
    and a modulus that makes up for it give the right normal force and a wrong tangential one.
    Root mean squares over the contacts of the loads.
    """
    values = slice(0, 1 + len(family.names))
    covariance = fit.covariance[values, values]
    variances = []
    for load in loads:
        change = load.inverse.sensitivity(family, fit.shape)
        slope = np.concatenate([np.ones((3, 1)), change], axis=1)
        variances.append(np.einsum("ij,jk,ik->i", slope, covariance, slope))
    x, y, z = np.mean(variances, axis=0)
    return float(np.sqrt(z)), float(np.sqrt((x + y) / 2))
