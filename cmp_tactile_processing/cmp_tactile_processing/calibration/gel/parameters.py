"""Parameters of the calibration by the gel's own pattern."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["GelCalibrationParameters"]


@dataclass(frozen=True)
class GelCalibrationParameters:
    """What may differ from the description by how much, and when the result is good enough.

    A deviation of 0 holds a value: it is not fitted at all.  Raises ParameterError for a value
    outside its range.
    """

    turn: float = parameter(
        0.035,
        "standard deviation of each turn of the gel, a mirror or a view's camera",
        unit="rad",
        low=0.0,
        high=0.5,
    )
    shift: float = parameter(
        1e-3,
        "standard deviation of each shift of the gel, a mirror or a view's camera",
        unit="m",
        low=0.0,
        high=0.1,
    )
    focal: float = parameter(
        0.02, "standard deviation of the focal length, relative to it", low=0.0, high=0.5
    )
    aspect: float = parameter(
        0.0, "standard deviation of the ratio fy / fx, relative to it", low=0.0, high=0.1
    )
    principal_point: float = parameter(
        5.0,
        "standard deviation of the principal point along x and along y",
        unit="px",
        low=0.0,
        high=200.0,
    )
    distortion: float = parameter(
        0.0, "standard deviation of each distortion coefficient", low=0.0, high=1.0
    )
    layer_z: float = parameter(
        0.0, "standard deviation of a refracting layer's plane", unit="m", low=0.0, high=0.01
    )
    layer_index: float = parameter(
        0.0, "standard deviation of a refracting layer's index", low=0.0, high=0.5
    )
    largest_deviation: float = parameter(
        4.0,
        "standard deviations from the description beyond which it is not that of this sensor",
        low=1.0,
        high=100.0,
    )
    robust_scale: float = parameter(
        3.0, "standard deviations from which on a corner counts less", low=0.5, high=100.0
    )
    fewest_frames: int = parameter(
        3, "frames below which nobody can tell whether the gel was still", low=1, high=1000
    )
    wanted_frames: int = parameter(
        8, "frames below which noise is averaged less than it could be", low=1, high=1000
    )
    least_seen: float = parameter(
        0.5, "share of the pattern that must be seen in each view", low=0.1, high=1.0
    )
    wanted_seen: float = parameter(
        0.95, "share of the pattern below which something hides the gel", low=0.1, high=1.0
    )
    still_limit: float = parameter(
        0.1,
        "change of the corners between frames, as a whole, above which something moved",
        unit="px",
        low=1e-3,
        high=10.0,
    )
    shape_limit: float = parameter(
        30e-6,
        "distance of the marker surface from its shape at rest, averaged over 3 x 3 corners, above "
        "which the gel is touched or the pattern is another one",
        unit="m",
        low=1e-6,
        high=1e-2,
    )
    shape_wanted: float = parameter(
        10e-6,
        "the same distance above which the description of the pattern could be better",
        unit="m",
        low=1e-6,
        high=1e-2,
    )
    reprojection_limit: float = parameter(
        0.5,
        "root mean square of the reprojection residuals that a good calibration has",
        unit="px",
        low=1e-3,
        high=10.0,
    )
    scale_limit: float = parameter(
        0.1,
        "relative change of all distances at once above which the pattern's pitch is doubted",
        low=1e-3,
        high=1.0,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "gel calibration")
