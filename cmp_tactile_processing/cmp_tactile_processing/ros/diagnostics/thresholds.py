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
        "share of frames missing in what the camera sends above which the view splitter warns",
        within=(0.0, 1.0),
    )
    tracked_warn: float = parameter(
        0.5, "tracked fraction of the pattern below which it is warned of", within=(0.0, 1.0)
    )
    tracked_error: float = parameter(
        0.0, "tracked fraction of the pattern below which it is an error", within=(0.0, 1.0)
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
