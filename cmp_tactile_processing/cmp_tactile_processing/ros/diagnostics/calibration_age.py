"""How old a calibration is."""

from __future__ import annotations

import math
import time
from datetime import datetime, timezone

__all__ = ["age_in_days", "age_text"]

SECONDS_PER_DAY = 86400.0


def age_in_days(date: str | None, now_s: float | None = None) -> float:
    """Days since a date as calibration writes it, ISO 8601 in UTC; NaN without one.

    now_s: since the epoch, else the system's clock: a recording's calibration ages, too.
    """
    if not date:
        return math.nan
    # Python 3.10 does not read the Z.
    made = datetime.fromisoformat(date[:-1] + "+00:00" if date.endswith("Z") else date)
    now = time.time() if now_s is None else now_s
    return (now - made.astimezone(timezone.utc).timestamp()) / SECONDS_PER_DAY


def age_text(days: float) -> str:
    """The age as a figure of the diagnostics."""
    return "no date recorded" if math.isnan(days) else f"{days:.1f}"
