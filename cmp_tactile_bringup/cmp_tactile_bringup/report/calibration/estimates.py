"""Estimates of a calibration in the units that people read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cmp_tactile_processing.calibration.outcome import Estimate

__all__ = ["HEADINGS", "EstimateRow", "estimate_rows"]

HEADINGS = ("Parameter", "Before", "After", "Change", "Std", "Unit", "")

READABLE_UNITS = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi), "Pa": ("kPa", 1e-3)}
# So many digits below the first of the standard deviation.
DIGITS_BELOW_STD = 2
FEWEST_DECIMALS, MOST_DECIMALS = 1, 6
DECIMALS_WITHOUT_STD = 4


@dataclass(frozen=True)
class EstimateRow:
    """A parameter as texts.

    Of one that is not determined: "held" where it kept its value, "partly" where the images tell
    it only together with others.
    """

    name: str
    before: str
    after: str
    change: str
    std: str
    unit: str
    state: str

    @property
    def texts(self) -> tuple[str, ...]:
        """What stands below HEADINGS."""
        return (self.name, self.before, self.after, self.change, self.std, self.unit, self.state)


def estimate_rows(estimates: Sequence[Estimate]) -> list[EstimateRow]:
    """A row for each estimate, those that the data determined first."""
    ordered = sorted(estimates, key=lambda item: (not item.determined, item.after == item.before))
    return [_row(item) for item in ordered]


def _row(estimate: Estimate) -> EstimateRow:
    unit, factor = READABLE_UNITS.get(estimate.unit, (estimate.unit, 1.0))
    std = estimate.std * factor
    places = _decimals(std)

    def text(value: float, sign: str = "") -> str:
        return f"{value:{sign}.{places}f}" if math.isfinite(value) else "-"

    change = (estimate.after - estimate.before) * factor
    return EstimateRow(
        name=estimate.name,
        before=text(estimate.before * factor),
        after=text(estimate.after * factor),
        change=text(change, "+") if change else "-",
        std=text(std) if estimate.determined else "-",
        unit=unit,
        state=_state(estimate),
    )


def _state(estimate: Estimate) -> str:
    if estimate.determined:
        return "determined"
    return "held" if estimate.after == estimate.before else "partly"


def _decimals(std: float) -> int:
    if not math.isfinite(std) or std <= 0:
        return DECIMALS_WITHOUT_STD
    below = DIGITS_BELOW_STD - math.ceil(math.log10(std))
    return min(max(below, FEWEST_DECIMALS), MOST_DECIMALS)
