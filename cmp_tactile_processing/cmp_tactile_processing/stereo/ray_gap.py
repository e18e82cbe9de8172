"""Tells a wrong sensor description from rays that miss each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Status

__all__ = ["PLAUSIBLE_RAY_GAP_M", "implausible_ray_gap"]

# On clean frames of the sample rig the median gap is 0.4 um with its own description and 177 um
# with that of the prototype; an error of a whole pixel in every corner makes 41 um.
PLAUSIBLE_RAY_GAP_M = 50e-6
# Fewer markers may all lie where one view is wrong: under glare, or at the rim of a contact.
MIN_MEASURED_SHARE = 0.5


def implausible_ray_gap(
    ray_gap: NDArray[np.float64], status: NDArray[np.uint8], sensor_name: str
) -> str:
    """Why the frame cannot come from that sensor; empty where it may.

    ray_gap, status (rows, cols): of a surface; gaps in m, NaN for a sensor with one view.  Markers
    that are missing for their gap alone count.
    """
    measured = (status != Status.PREDICTED) & np.isfinite(ray_gap)
    gaps = ray_gap[measured]
    if not gaps.size or np.mean(measured) < MIN_MEASURED_SHARE:
        return ""
    median = float(np.median(gaps))
    if median <= PLAUSIBLE_RAY_GAP_M:
        return ""
    return (
        f"left and right rays miss each other by {median * 1e6:.0f} um, expected at most "
        f"{PLAUSIBLE_RAY_GAP_M * 1e6:.0f} um: is {sensor_name} the description of this sensor?"
    )
