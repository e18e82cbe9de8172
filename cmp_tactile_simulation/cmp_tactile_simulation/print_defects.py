"""Flaws of a printed pattern, as fixed functions of the place on the skin."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.parameters import check_parameters, parameter

__all__ = ["PrintDefects"]


@dataclass(frozen=True)
class PrintDefects:
    """What is wrong with the print; the places are set by the seed.

    Raises ParameterError for a value outside its range.
    """

    missing_ink: int = parameter(0, "number of blobs without ink on the pattern", low=0, high=10000)
    splashes: int = parameter(0, "number of blobs of ink on the pattern", low=0, high=10000)
    blob_radius: float = parameter(
        8e-5,
        "mean radius of a blob; single ones have half to one and a half of it",
        unit="m",
        low=1e-6,
        high=5e-3,
    )
    ragged_edge: float = parameter(
        0.0, "standard deviation by which the printed edges stray", unit="m", low=0, high=2e-4
    )
    ragged_length: float = parameter(
        5e-5, "length over which the edges' straying changes", unit="m", low=1e-5, high=5e-3
    )

    def __post_init__(self) -> None:
        check_parameters(self, "print")
