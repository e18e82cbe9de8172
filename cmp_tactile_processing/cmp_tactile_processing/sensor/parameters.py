"""Parameters of the stages: one frozen dataclass each, the only home of every default.

Files are read, and the ROS parameter descriptors and the documentation made, by what `parameter`
attaches to each field.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from cmp_tactile_processing.errors import InputError, found_text
from cmp_tactile_processing.sensor.yaml_file import Part, choice, meant, number


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = "",
    within: tuple[float | None, float | None] = (None, None),
    choices: tuple[str, ...] = (),
) -> Any:
    """A dataclass field with the metadata that descriptors and documentation are made from.

    within: least and largest value, None for one that is not limited.
    """
    limits = {"unit": unit, "low": within[0], "high": within[1], "choices": choices}
    rule = {} if isinstance(default, (bool, str, tuple)) else number(*_limits(limits), unit)
    rule = choice(*choices) if choices else rule
    return field(default=default, metadata={**limits, **rule, "description": description})


def check_parameters(parameters: Any, owner: str = "") -> None:
    """Raise InputError for the first field of a dataclass instance outside its range.

    owner: the section that the fields belong to; without one they are a node's parameters.
    """
    for item in fields(parameters):
        value, meta = getattr(parameters, item.name), item.metadata
        expected = ""
        if meta["choices"] and value not in meta["choices"]:
            expected = "one of " + ", ".join(meta["choices"])
        elif isinstance(item.default, tuple):
            if not _are_within(value, item.default, meta):
                expected = f"{numbers_text(item.default, meta)} {meta['unit']}"
        elif not meta["choices"] and not _is_like(value, item.default):
            expected = f"a value like {item.default!r}"
        elif _is_like(value, 0.0) and not abs(value) <= sys.float_info.max:
            expected = "a finite number"
        elif meta["low"] is not None and not value >= meta["low"]:
            expected = f"at least {meta['low']} {meta['unit']}".rstrip()
        elif meta["high"] is not None and not value <= meta["high"]:
            expected = f"at most {meta['high']} {meta['unit']}".rstrip()
        if expected:
            where = f"{owner}.{item.name}" if owner else f"parameter {item.name}"
            found = list(value) if isinstance(value, tuple) else value
            hint = meant([value], meta["unit"], *_limits(meta))
            msg = f"{where}: found {found_text(found)}, expected {expected.rstrip()}{hint}"
            raise InputError(msg)


class Parameters(Part):
    """Base of dataclasses that have fields of `parameter`; InputError for one out of range.

    section: of a file that the fields belong to; without one they are a node's parameters.
    """

    _section = ""

    def __init_subclass__(cls, section: str = "") -> None:
        cls._section = section or cls._section

    def __post_init__(self) -> None:
        check_parameters(self, self._section)


def numbers_text(default: tuple[float, ...], meta: Mapping[str, Any]) -> str:
    """What a field of several numbers may be; its metadata have both ends of a range."""
    return f"{len(default)} numbers from {meta['low']:.3g} to {meta['high']:.3g}"


def check_grey_weights(weights: tuple[float, float, float]) -> None:
    """Raise InputError where weights of red, green and blue leave all colours alike."""
    total = sum(abs(weight) for weight in weights)
    if not math.isfinite(total) or total == 0:
        found = ", ".join(f"{weight:g}" for weight in weights)
        msg = (
            f"tracking.red, tracking.green, tracking.blue: found {found}, expected numbers that "
            "are not all 0"
        )
        raise InputError(msg)


def _limits(meta: Mapping[str, Any]) -> tuple[float, float]:
    low, high = meta["low"], meta["high"]
    return -math.inf if low is None else low, math.inf if high is None else high


def _are_within(values: Any, default: tuple[float, ...], meta: Mapping[str, Any]) -> bool:
    # NaN is not within either.
    return (
        isinstance(values, tuple)
        and len(values) == len(default)
        and all(_is_like(value, 0.0) and meta["low"] <= value <= meta["high"] for value in values)
    )


def _is_like(value: Any, default: Any) -> bool:
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, (int, float))
    return isinstance(value, type(default))


@dataclass(frozen=True)
class ForceParameters(Parameters, section="force"):
    """Parameters of the force stage."""

    regularization: float = parameter(
        0.0,
        "weight of smoothness in the first pass, relative to the model's largest singular value; "
        "0 chooses it for every frame",
        within=(0.0, 1.0),
    )
    smoothing_length: float = parameter(
        1.5e-3,
        "length over which the traction is assumed smooth",
        unit="m",
        within=(1e-5, 0.1),
    )
    two_pass: bool = parameter(
        True, "solve a second time on the nodes that were in contact in the first pass"
    )
    large_press: str = parameter(
        "auto",
        "large-strain correction; auto: for neo_hookean gels only",
        choices=("auto", "on", "off"),
    )
    model_error: float = parameter(
        3e-3,
        "relative standard deviation of the force due to mesh and material model",
        within=(0.0, 1.0),
    )
    noise_in_plane: float = parameter(
        2e-6,
        "standard deviation of a measured marker displacement along x and y",
        unit="m",
        within=(1e-9, 1e-3),
    )
    noise_depth: float = parameter(
        5e-6,
        "standard deviation of a measured marker displacement along z",
        unit="m",
        within=(1e-9, 1e-3),
    )
    min_valid_fraction: float = parameter(
        0.3, "no force below this share of valid markers", within=(0.0, 1.0)
    )
    contact_threshold: float = parameter(
        0.1,
        "a node in contact has at least this share of the largest force component of all nodes",
        within=(0.0, 1.0),
    )
    contact_pressure_floor: float = parameter(
        500.0, "a node in contact has at least this normal pressure", unit="Pa", within=(0.0, None)
    )
    contact_deviations: float = parameter(
        3.0,
        "a node in contact has at least this normal pressure, in standard deviations of its noise",
        within=(0.0, 100.0),
    )
    contact_evidence: float = parameter(
        12.0,
        "contact is reported above this logarithm of the odds of a force against noise alone",
        within=(0.0, 1000.0),
    )


@dataclass(frozen=True)
class SlipParameters(Parameters, section="slip"):
    """Parameters of the slip estimate."""

    min_normal_force: float = parameter(
        0.2,
        "no slip is reported for a contact with less normal force",
        unit="N",
        within=(0.0, None),
    )
    min_traction_ratio: float = parameter(
        0.1,
        "no slip is reported below this ratio of tangential to normal force, since the start of "
        "the current load",
        within=(0.01, 1.0),
    )
    incipient_ratio: float = parameter(
        0.35,
        "slip is incipient if at least this share of the contact slides, weighted by normal "
        "force; below it the contact sticks",
        within=(0.0, 1.0),
    )
    full_ratio: float = parameter(
        0.75,
        "slip is full if at least this share of the contact slides, weighted by normal force, and "
        "the traction ratio is steady; the share has an error of up to 0.2",
        within=(0.0, 1.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.incipient_ratio > self.full_ratio:
            msg = (
                f"slip.incipient_ratio: found {self.incipient_ratio!r}, expected at most "
                f"slip.full_ratio, {self.full_ratio!r}"
            )
            raise InputError(msg)


@dataclass(frozen=True)
class TrackingParameters(Parameters, section="tracking"):
    """Parameters of the tracking stage."""

    detector: str = parameter(
        "saddle_lattice",
        "gridline detector: a lattice of saddle points joined by edges, or the paper's stitched "
        "outlines of checkers (III.A)",
        choices=("saddle_lattice", "contour_stitching"),
    )
    virtual_markers: str = parameter(
        "fused",
        "virtual markers: edge measurements fused with the curve through the corners, or the "
        "paper's local sub-pixel correction (III.C)",
        choices=("fused", "local_correction"),
    )
    follow: bool = parameter(
        True,
        "look for the corners at their last places first; detect them again only if this fails",
    )
    red: float = parameter(
        0.299, "weight of red in the grey value of a colour image", within=(-1.0, 1.0)
    )
    green: float = parameter(
        0.587, "weight of green in the grey value of a colour image", within=(-1.0, 1.0)
    )
    blue: float = parameter(
        0.114, "weight of blue in the grey value of a colour image", within=(-1.0, 1.0)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_grey_weights(self.grey_weights)

    @property
    def grey_weights(self) -> tuple[float, float, float]:
        """Weights of red, green and blue, as `split.to_grey` takes them."""
        return self.red, self.green, self.blue


@dataclass(frozen=True)
class TriangulationParameters(Parameters, section="triangulation"):
    """Parameters of the triangulation stage."""

    method: str = parameter(
        "weighted",
        "least squares of both views' pixels, weighted by their standard deviations, or the "
        "midpoint of the common normal of both rays (paper, IV.A)",
        choices=("weighted", "common_normal"),
    )
    max_ray_gap: float = parameter(
        150e-6,
        "a marker is rejected if the common normal of its rays is longer",
        unit="m",
        within=(1e-7, 1e-2),
    )
    corner_noise: float = parameter(
        0.02,
        "standard deviation of corners, and of virtual markers across their gridline, if none is "
        "known",
        unit="px",
        within=(1e-4, 10.0),
    )
