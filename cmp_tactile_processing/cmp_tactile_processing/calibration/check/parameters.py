"""Limits of the check of a recording."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["CheckParameters"]


@dataclass(frozen=True)
class CheckParameters:
    """What a recording of a well calibrated sensor keeps to.

    The limits of statistics hold for 95 % of the markers.  Raises ParameterError for a value
    outside its range.
    """

    reprojection: float = parameter(
        0.3,
        "distance of a corner from the projection of its point in space",
        unit="px",
        low=1e-3,
        high=100.0,
    )
    epipolar: float = parameter(
        0.6,
        "distance of a corner of the right view from the curve on which the left view's ray is "
        "seen",
        unit="px",
        low=1e-3,
        high=100.0,
    )
    ray_gap: float = parameter(
        25e-6,
        "distance of the rays of both views at a marker",
        unit="m",
        low=1e-7,
        high=1e-2,
    )
    tracked: float = parameter(
        0.8, "share of the markers that both views measured, all frames together", low=0.0, high=1.0
    )
    still: float = parameter(
        0.15,
        "change from one frame to the next up to which the gel is still",
        unit="px",
        low=1e-3,
        high=10.0,
    )
    rest_shape: float = parameter(
        60e-6,
        "deviation from the rest shape, moved and scaled as a whole, up to which nothing touches",
        unit="m",
        low=1e-6,
        high=1e-2,
    )
    turn: float = parameter(
        5e-3, "turn of the gel at rest since calibration", unit="rad", low=1e-5, high=1.0
    )
    shift: float = parameter(
        50e-6, "shift of the gel at rest since calibration", unit="m", low=1e-7, high=1e-2
    )
    scale: float = parameter(
        5e-3, "relative growth of the gel at rest since calibration", low=1e-5, high=1.0
    )
    shape: float = parameter(
        30e-6,
        "deviation of the gel at rest from its known shape, when that is moved as a whole",
        unit="m",
        low=1e-6,
        high=1e-2,
    )
    rest_reprojection: float = parameter(
        1.0,
        "root mean square distance of the corners at rest from where the description has them",
        unit="px",
        low=1e-3,
        high=100.0,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "check")
