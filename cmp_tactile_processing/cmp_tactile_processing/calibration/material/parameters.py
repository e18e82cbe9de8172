"""Parameters of the calibration of the gel's material."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["MaterialOptions"]


@dataclass(frozen=True)
class MaterialOptions:
    """How well the material is known before, and when the result is good enough.

    What is not fitted is taken for exact: the dimensions unless they are asked for, and values with
    a factor of 1 or a deviation of 0.  Raises ParameterError for a value outside its range.
    """

    fit_thickness: bool = parameter(False, "fit the gel's thickness, too")
    fit_layer_thickness: bool = parameter(False, "fit the shading layer's thickness, too")
    fit_layer_young: bool = parameter(
        False, "fit the ratio of the shading layer's modulus to the gel's, too"
    )

    young_factor: float = parameter(
        3.0,
        "factor within which Young's modulus is right, for two standard deviations",
        low=1.001,
        high=100.0,
    )
    poisson: float = parameter(0.015, "standard deviation of Poisson's ratio", low=0.0, high=0.1)
    thickness: float = parameter(
        0.03, "standard deviation of the gel's thickness, relative to it", low=0.0, high=0.15
    )
    layer_thickness: float = parameter(
        0.2,
        "standard deviation of the shading layer's thickness, relative to it",
        low=0.0,
        high=0.5,
    )
    layer_factor: float = parameter(
        3.0,
        "factor within which the ratio of the shading layer's modulus to the gel's is right, for "
        "two standard deviations",
        low=1.0,
        high=10.0,
    )
    offset: float = parameter(
        0.2,
        "standard deviation of the zero offset of a reference force sensor, each component",
        unit="N",
        low=0.0,
        high=100.0,
    )
    torque_offset: float = parameter(
        2e-3,
        "standard deviation of the zero offset of a reference sensor's torque, each component",
        unit="N m",
        low=0.0,
        high=10.0,
    )
    model_error: float = parameter(
        0.005,
        "standard deviation of a load's force as the model shows it, relative to the force; all "
        "loads have it in common",
        low=0.0,
        high=0.5,
    )
    shape_error: float = parameter(
        0.004,
        "standard deviation of how the model spreads the gel's movement, relative to it; all loads "
        "have it in common",
        low=0.0,
        high=0.5,
    )
    least_load: float = parameter(
        5.0,
        "standard deviations of the force that the noise alone would show, below which a load is "
        "left out",
        low=1.0,
        high=100.0,
    )
    strain_error: float = parameter(
        0.03,
        "share of the force by which large strain may change it before a linear gel is doubted",
        low=1e-3,
        high=1.0,
    )
    outlier: float = parameter(
        5.0,
        "standard deviations from the fit beyond which a load is left out",
        low=2.0,
        high=100.0,
    )
    held_share: float = parameter(
        0.5,
        "share of a value's prior deviation that the loads must fall below to change the value",
        low=0.01,
        high=1.0,
    )
    force_limit: float = parameter(
        0.2,
        "relative standard deviation of the normal force above which the result is not accepted",
        low=1e-3,
        high=10.0,
    )
    force_wanted: float = parameter(
        0.03,
        "relative standard deviation of normal and tangential force that a good result has",
        low=1e-3,
        high=10.0,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "material calibration")
