"""How the markers are drawn."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["MarkerParameters"]


@dataclass(frozen=True)
class MarkerParameters:
    """How the markers are drawn."""

    displacement_gain: float = parameter(
        1.0, "drawn length of a displacement arrow per displacement; 0: none", low=0.0, high=1e3
    )
    force_gain: float = parameter(
        0.05,
        "drawn length of a force arrow per force on a node; 0: none",
        unit="m/N",
        low=0.0,
        high=1e3,
    )
    depth_range: float = parameter(
        0.001, "indentation at which the colour of the mesh ends", unit="m", low=1e-6, high=1.0
    )
    resultant_gain: float = parameter(
        0.001,
        "drawn length of the arrow of a contact's force per force; 0: none",
        unit="m/N",
        low=0.0,
        high=1e3,
    )
    moment_gain: float = parameter(
        0.5,
        "drawn length of the arrow of a contact's moment per moment; 0: none",
        unit="m/(N m)",
        low=0.0,
        high=1e5,
    )
    contact_text: bool = parameter(
        True, "whether normal force, area and slip state are written at each contact"
    )
    legend: bool = parameter(
        True, "whether a bar with the colours of depth and the scales of the arrows is drawn"
    )
    text_size: float = parameter(0.0006, "height of the letters", unit="m", low=1e-6, high=1.0)
    line_width: float = parameter(
        0.00005,
        "width of arrows, half that of outlines, a third of that of resultants and moments",
        unit="m",
        low=1e-6,
        high=1.0,
    )
    max_rate: float = parameter(
        15.0,
        "markers are drawn so often at most; 0: with every message",
        unit="Hz",
        low=0.0,
        high=1000.0,
    )
    lifetime: float = parameter(
        2.0,
        "time after which markers vanish that are not drawn anew; 0: never",
        unit="s",
        low=0.0,
        high=3600.0,
    )

    def __post_init__(self) -> None:
        check_parameters(self, "markers")
