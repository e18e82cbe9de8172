"""From where on the figures of a node's diagnostics are warned of."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["SECTION", "DiagnosticsParameters"]

SECTION = "diagnostics"
# The first must not exceed the second.
ORDERED = (
    ("rate_error", "rate_warn"),
    ("late_warn", "late_error"),
    ("dropped_warn", "dropped_error"),
    ("tracked_error", "tracked_warn"),
    ("lost_below", "found_from"),
)


@dataclass(frozen=True)
class DiagnosticsParameters:
    """Thresholds of the diagnostics, the same in every node; shares are of one second's frames."""

    rate_warn: float = parameter(
        0.0,
        "rate of results below which it is warned of; 0: any will do",
        unit="Hz",
        within=(0.0, None),
    )
    rate_error: float = parameter(
        0.0, "rate of results below which it is an error; 0: none is", unit="Hz", within=(0.0, None)
    )
    late_after: float = parameter(
        0.1, "age of its camera frame from which on a result is late", unit="s", within=(1e-3, 10.0)
    )
    late_warn: float = parameter(
        0.05, "share of late results above which it is warned of", within=(0.0, 1.0)
    )
    late_error: float = parameter(
        1.0, "share of late results above which it is an error", within=(0.0, 1.0)
    )
    dropped_warn: float = parameter(
        0.01, "share of dropped frames above which it is warned of", within=(0.0, 1.0)
    )
    dropped_error: float = parameter(
        0.5, "share of dropped frames above which it is an error", within=(0.0, 1.0)
    )
    missing_warn: float = parameter(
        0.1,
        "share of frames missing already where they come from above which it is warned of",
        within=(0.0, 1.0),
    )
    queue_warn: float = parameter(
        0.5, "share of the input queue that waits above which it is warned of", within=(0.0, 1.0)
    )
    tracked_warn: float = parameter(
        0.5, "tracked fraction of the pattern below which it is warned of", within=(0.0, 1.0)
    )
    tracked_error: float = parameter(
        0.0, "tracked fraction of the pattern below which it is an error", within=(0.0, 1.0)
    )
    lost_below: float = parameter(
        0.1, "tracked fraction below which the pattern counts as lost", within=(0.0, 1.0)
    )
    found_from: float = parameter(
        0.3, "tracked fraction from which on it counts as found again", within=(0.0, 1.0)
    )
    losses_warn: int = parameter(
        5,
        "losses of the pattern within a minute from which on it is warned of; 0: none is",
        within=(0, 1000),
    )
    calibration_age_warn: float = parameter(
        365.0,
        "age of the calibration above which it is warned of; 0: any will do",
        unit="d",
        within=(0.0, 36500.0),
    )
    report_after: int = parameter(
        2, "reports in a row beyond a threshold before that is reported", within=(1, 60)
    )
    clear_after: int = parameter(
        3, "reports in a row within it before that is no longer reported", within=(1, 60)
    )

    def __post_init__(self) -> None:
        check_parameters(self, SECTION)
        for lesser, greater in ORDERED:
            found, limit = getattr(self, lesser), getattr(self, greater)
            if found > limit:
                msg = (
                    f"{SECTION}.{lesser}: found {found!r}, expected at most "
                    f"{SECTION}.{greater}, {limit!r}"
                )
                raise ParameterError(msg)
