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
        "WARN below this rate of results; 0: never",
        unit="Hz",
        within=(0.0, None),
    )
    rate_error: float = parameter(
        0.0, "ERROR below this rate of results; 0: never", unit="Hz", within=(0.0, None)
    )
    late_after: float = parameter(
        0.1,
        "a result is late if its camera frame is older than this",
        unit="s",
        within=(1e-3, 10.0),
    )
    late_warn: float = parameter(0.05, "WARN above this share of late results", within=(0.0, 1.0))
    late_error: float = parameter(1.0, "ERROR above this share of late results", within=(0.0, 1.0))
    dropped_warn: float = parameter(
        0.01, "WARN above this share of dropped frames", within=(0.0, 1.0)
    )
    dropped_error: float = parameter(
        0.5, "ERROR above this share of dropped frames", within=(0.0, 1.0)
    )
    missing_warn: float = parameter(
        0.1,
        "WARN of the view splitter above this share of frames that the camera did not send",
        within=(0.0, 1.0),
    )
    tracked_warn: float = parameter(
        0.5, "WARN below this tracked fraction of the pattern", within=(0.0, 1.0)
    )
    tracked_error: float = parameter(
        0.0, "ERROR below this tracked fraction of the pattern", within=(0.0, 1.0)
    )
    calibration_age_warn: float = parameter(
        365.0,
        "WARN above this age of the calibration; 0: never",
        unit="d",
        within=(0.0, 36500.0),
    )
    report_after: int = parameter(
        2,
        "a threshold must be exceeded in this many reports in a row before the level changes",
        within=(1, 60),
    )
    clear_after: int = parameter(
        3,
        "a threshold must be kept in this many reports in a row before the level goes back",
        within=(1, 60),
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
