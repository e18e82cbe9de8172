"""From where on a figure of the diagnostics is warned of, or an error."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

SECTION = "diagnostics"
# The first must not exceed the second.
ORDERED = (
    ("rate_error", "rate_warn"),
    ("late_warn", "late_error"),
    ("dropped_warn", "dropped_error"),
    ("tracked_error", "tracked_warn"),
)


@dataclass(frozen=True)
class DiagnosticsParameters:
    """Thresholds of the diagnostics, the same in every node; shares are of one second's frames."""

    rate_warn: float = parameter(
        0.0,
        "rate of results below which a warning is given; 0: never",
        unit="Hz",
        within=(0.0, None),
    )
    rate_error: float = parameter(
        0.0,
        "rate of results below which an error is given; 0: never",
        unit="Hz",
        within=(0.0, None),
    )
    late_after: float = parameter(
        0.1, "age of its camera frame above which a result is late", unit="s", within=(1e-3, 10.0)
    )
    late_warn: float = parameter(
        0.05, "share of late results above which a warning is given", within=(0.0, 1.0)
    )
    late_error: float = parameter(
        1.0, "share of late results above which an error is given", within=(0.0, 1.0)
    )
    dropped_warn: float = parameter(
        0.01, "share of dropped frames above which a warning is given", within=(0.0, 1.0)
    )
    dropped_error: float = parameter(
        0.5, "share of dropped frames above which an error is given", within=(0.0, 1.0)
    )
    missing_warn: float = parameter(
        0.1,
        "share of frames missing from the camera above which the view splitter gives a warning",
        within=(0.0, 1.0),
    )
    tracked_warn: float = parameter(
        0.5, "tracked fraction of the pattern below which a warning is given", within=(0.0, 1.0)
    )
    tracked_error: float = parameter(
        0.0, "tracked fraction of the pattern below which an error is given", within=(0.0, 1.0)
    )
    calibration_age_warn: float = parameter(
        365.0,
        "age of the calibration above which a warning is given; 0: never",
        unit="d",
        within=(0.0, 36500.0),
    )
    report_after: int = parameter(
        2, "reports in a row beyond a threshold before a problem is reported", within=(1, 60)
    )
    clear_after: int = parameter(
        3, "reports in a row within a threshold before the problem is cleared", within=(1, 60)
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
