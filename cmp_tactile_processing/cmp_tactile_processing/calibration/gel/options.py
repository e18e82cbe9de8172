"""When a calibration by the gel's own pattern is good enough."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.calibration.rig import RigPrior
from cmp_tactile_processing.sensor.parameters import parameter


@dataclass(frozen=True)
class GelCalibrationParameters(RigPrior, section="gel calibration"):
    """What may differ from the description by how much, and when the result is good enough.

    A deviation of 0 holds a value: it is not fitted at all.  Raises ParameterError for a value
    outside its range.
    """

    largest_deviation: float = parameter(
        4.0,
        "standard deviations from the description beyond which it is not that of this sensor",
        within=(1.0, 100.0),
    )
    robust_scale: float = parameter(
        3.0, "standard deviations from which on a corner counts less", within=(0.5, 100.0)
    )
    fewest_frames: int = parameter(
        3, "frames below which nobody knows whether the gel was still", within=(1, 1000)
    )
    wanted_frames: int = parameter(
        8, "frames below which noise is averaged less than it could be", within=(1, 1000)
    )
    least_seen: float = parameter(
        0.5, "share of the pattern that must be seen in each view", within=(0.1, 1.0)
    )
    wanted_seen: float = parameter(
        0.95, "share of the pattern below which something hides the gel", within=(0.1, 1.0)
    )
    still_limit: float = parameter(
        0.1,
        "change of the corners between frames, as a whole, above which something moved",
        unit="px",
        within=(1e-3, 10.0),
    )
    shape_limit: float = parameter(
        30e-6,
        "distance of the marker surface from its shape at rest, averaged over 3 x 3 corners, above "
        "which the gel is touched or the pattern is another one",
        unit="m",
        within=(1e-6, 1e-2),
    )
    shape_wanted: float = parameter(
        10e-6,
        "the same distance above which the description of the pattern could be better",
        unit="m",
        within=(1e-6, 1e-2),
    )
    reprojection_limit: float = parameter(
        0.5,
        "root mean square of the reprojection residuals that a good calibration has",
        unit="px",
        within=(1e-3, 10.0),
    )
    scale_limit: float = parameter(
        0.1,
        "relative change of all distances at once above which the pattern's pitch is doubted",
        within=(1e-3, 1.0),
    )
