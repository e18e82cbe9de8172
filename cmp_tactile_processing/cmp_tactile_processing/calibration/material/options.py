"""What is known before the material is calibrated, and what the result should be like."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import Parameters, parameter


@dataclass(frozen=True)
class MaterialOptions(Parameters, section="material calibration"):
    """How well material and reference are known before, and when the result is good enough.

    Raises ParameterError for a value outside its range.
    """

    young_factor: float = parameter(
        3.0,
        "factor within which the described Young's modulus is right, at two standard deviations",
        within=(1.001, 100.0),
    )
    poisson: float = parameter(
        0.015,
        "standard deviation of the described Poisson's ratio, for the error bars; 0: it is exact",
        within=(0.0, 0.1),
    )
    offset: float = parameter(
        0.2,
        "standard deviation of the zero offset of a reference force sensor, of each component",
        unit="N",
        within=(0.0, 100.0),
    )
    model_error: float = parameter(
        0.005,
        "standard deviation of the model's force, relative to the force, common to all loads",
        within=(0.0, 0.5),
    )
    least_load: float = parameter(
        5.0,
        "force, in standard deviations of its noise, below which a load is left out",
        within=(1.0, 100.0),
    )
    strain_error: float = parameter(
        0.03,
        "relative change of the force by large strain above which a linear gel is doubtful",
        within=(1e-3, 1.0),
    )
    outlier: float = parameter(
        5.0,
        "distance from the fit, in standard deviations, above which a load is left out",
        within=(2.0, 100.0),
    )
    force_limit: float = parameter(
        0.2,
        "relative standard deviation of the normal force above which the result is refused",
        within=(1e-3, 10.0),
    )
    force_wanted: float = parameter(
        0.03,
        "relative standard deviation of normal and tangential force in a good result",
        within=(1e-3, 10.0),
    )
