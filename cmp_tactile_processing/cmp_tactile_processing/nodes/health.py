"""What the results of the last second show of the sensor, for the diagnostics of each stage."""

from __future__ import annotations

from collections import Counter

from cmp_tactile_processing.errors import Finding, Severity
from cmp_tactile_processing.force.advice import ADVICE, UNUSABLE, flag_names, single_flags
from cmp_tactile_processing.measured import ForceField, ForceFlag, Grid, GridFault
from cmp_tactile_processing.surface.reference_keeping import ReferenceKeeper

FAULT_LEVELS = {
    # A hand in front of the gel, or a finger in it: what it is made for.
    GridFault.NONE: Severity.OK,
    GridFault.PARTLY_HIDDEN: Severity.OK,
    # Light, dirt or something in the way.
    GridFault.DARK: Severity.WARNING,
    GridFault.OVEREXPOSED: Severity.WARNING,
    GridFault.NO_CONTRAST: Severity.WARNING,
    GridFault.NO_PATTERN: Severity.WARNING,
    GridFault.TWO_PATTERNS: Severity.WARNING,
    GridFault.AMBIGUOUS: Severity.WARNING,
    # The sensor description is not that of this sensor: it does not pass by itself.
    GridFault.OTHER_SIZE: Severity.ERROR,
    GridFault.OTHER_PATTERN: Severity.ERROR,
    GridFault.MIRRORED: Severity.ERROR,
    GridFault.TURNED: Severity.ERROR,
    GridFault.OTHER_COLOURS: Severity.ERROR,
}

# The others are reported, but belong to ordinary use.
WARNED_OF = UNUSABLE & ~ForceFlag.BEYOND_MARKERS | ForceFlag.NOT_CONVERGED
# A flag is reported where it holds in this share of a second's fields.
REPORTED_FROM = 0.5


class GridHealth:
    """Gathers grids; `close_period` reports those that came since the last call."""

    def __init__(self) -> None:
        self._faults: list[tuple[GridFault, str]] = []
        self._found = 0.0

    def add(self, grid: Grid) -> None:
        """Take a grid into account."""
        self._faults.append((grid.fault, grid.reason))
        self._found = grid.found_fraction

    def close_period(self) -> tuple[Finding, dict[str, str]]:
        """The worst fault of the period, and figures, which are empty if no grid came."""
        faults, self._faults = self._faults, []
        if not faults:
            return Finding(Severity.OK, ""), {}
        # The last one of those that are equally bad.
        worst, reason = max(reversed(faults), key=lambda item: FAULT_LEVELS[item[0]])
        faulty = sum(fault is not GridFault.NONE for fault, _ in faults)
        figures = {
            "tracked fraction": f"{self._found:.4f}",
            "fault": worst.value,
            "frames with a fault": f"{faulty} of {len(faults)}",
        }
        return Finding(FAULT_LEVELS[worst], reason), figures


def reference_figures(keeper: ReferenceKeeper) -> dict[str, object]:
    """Figures by name."""
    figures: dict[str, object] = {
        "reference id": keeper.reference.id,
        "reference frames": keeper.reference.frames,
        "waiting for a reference": keeper.waiting,
    }
    drift = keeper.drift
    if drift is not None:
        figures |= {
            "drift (um)": f"{drift.largest * 1e6:.1f}",
            "drift shift (um)": f"{drift.shift * 1e6:.1f}",
            "drift turn (mrad)": f"{drift.turn * 1e3:.3f}",
            "drift shape (um)": f"{drift.shape * 1e6:.1f}",
        }
    return figures


class ForceHealth:
    """Gathers force fields; `close_period` reports those that came since the last call."""

    def __init__(self) -> None:
        self._last: ForceField | None = None
        # Fields by all their flags: to take these apart for each field would cost more.
        self._counts: Counter[int] = Counter()

    def add(self, field: ForceField) -> None:
        """Take a field into account."""
        self._last = field
        self._counts[int(field.flags)] += 1

    def close_period(self) -> tuple[Finding, dict[str, str]]:
        """The advice on flags of the period, and figures."""
        counts, self._counts = self._counts, Counter()
        reported = ForceFlag.NONE
        for flag in ADVICE:
            held = sum(fields for flags, fields in counts.items() if flags & flag)
            if held and held >= REPORTED_FROM * counts.total():
                reported |= flag
        # What is warned of comes first.
        flags = sorted(single_flags(reported), key=lambda flag: not flag & WARNED_OF)
        severity = Severity.WARNING if reported & WARNED_OF else Severity.OK
        figures = {"flags": flag_names(reported)}
        if self._last is not None:
            figures |= {
                "contacts": str(len(self._last.contacts)),
                "slip": self._last.slip_state.name.lower(),
            }
        return Finding(severity, "; ".join(ADVICE[flag] for flag in flags)), figures
