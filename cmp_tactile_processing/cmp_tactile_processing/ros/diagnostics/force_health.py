"""What the force fields of the last second say, for the reconstructor's diagnostics."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from numpy.typing import NDArray

from cmp_tactile_processing.force.advice import ADVICE, flag_names, single_flags
from cmp_tactile_processing.measured.force_field import ForceField, ForceFlag

__all__ = ["WARNED_OF", "ForceHealth"]

# The others are told, but belong to ordinary use.
WARNED_OF = (
    ForceFlag.FEW_MARKERS | ForceFlag.NOT_CONVERGED | ForceFlag.POOR_FIT | ForceFlag.IMPLAUSIBLE
)
# A flag is told once it holds in this share of a second's fields, and until it holds in less than
# the other: one that comes and goes from frame to frame is told without a break.
TOLD_FROM = 0.5
TOLD_UNTIL = 0.1


class ForceHealth:
    """Gathers force fields; `close_period` tells of those that came since the last call."""

    def __init__(self) -> None:
        self._told = ForceFlag.NONE
        self._last: ForceField | None = None
        self._begin()

    def _begin(self) -> None:
        self._fields = 0
        self._counts = dict.fromkeys(ADVICE, 0)

    def add(self, field: ForceField) -> None:
        """Take a field into account."""
        self._last = field
        self._fields += 1
        for flag in single_flags(field.flags):
            self._counts[flag] += 1

    def close_period(self) -> tuple[bytes, str, dict[str, str]]:
        """Level, advice and figures; the advice is empty where there is nothing to say.

        A period without fields changes nothing; the figures are the last field's.
        """
        if self._fields:
            self._told = self._renewed()
        self._begin()
        # What is warned of comes first.
        told = sorted(single_flags(self._told), key=lambda flag: not flag & WARNED_OF)
        level = DiagnosticStatus.WARN if self._told & WARNED_OF else DiagnosticStatus.OK
        return level, "; ".join(ADVICE[flag] for flag in told), self._figures()

    def _renewed(self) -> ForceFlag:
        told = ForceFlag.NONE
        for flag, count in self._counts.items():
            if count >= self._fields * (TOLD_UNTIL if flag & self._told else TOLD_FROM):
                told |= flag
        return told

    def _figures(self) -> dict[str, str]:
        figures = {"flags": flag_names(self._told)}
        field = self._last
        if field is None:
            return figures
        force, moment = np.split(field.wrench_std, 2)
        return figures | {
            "tracked fraction": f"{field.valid_fraction:.4f}",
            "noise scale": f"{field.noise_scale:.2f}",
            "force std (N)": _numbers(force, "{:.3f}"),
            "moment std (N mm)": _numbers(moment * 1e3, "{:.2f}"),
            "contacts": str(len(field.contacts)),
            "slip": field.slip_state.name.lower(),
            "large press corrected": "yes" if field.corrected else "no",
            "relaxation taken out": "yes" if field.relaxed else "no",
        }


def _numbers(values: NDArray[np.float64], form: str) -> str:
    return " ".join(form.format(value) for value in values)
