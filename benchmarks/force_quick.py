"""The table of load cases: errors at 10 N and at 1 N against the limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from force_cases import ForceCase
from force_errors import ForceErrors, Limits, errors_of, oracle_l2

from cmp_tactile_processing.force.model import ForceModel

QUICK_LOADS = (10.0, 1.0)
HEADER = (
    f"{'case':20s} {'N':>4s} | {'Fz %':>6s} {'bias %':>6s} {'limit':>5s} | "
    f"{'Ft N':>6s} {'limit':>6s} | "
    f"{'torque N mm':>11s} | {'L2 %':>5s} {'limit':>5s} {'oracle':>6s} | "
    f"{'area %':>6s} {'contacts':>8s} | verdict"
)


def case_lines(
    model: ForceModel, cases: Sequence[ForceCase], frames: int, oracle: bool
) -> Iterator[str]:
    """A line for each case at 10 N and 1 N, after the header."""
    yield HEADER
    for case in cases:
        if case.newton not in QUICK_LOADS:
            continue
        errors, limits = errors_of(model, case, frames), Limits.from_case(case)
        best = oracle_l2(model, case) if oracle else float("nan")
        yield case_line(case, errors, limits, best)


def case_line(case: ForceCase, errors: ForceErrors, limits: Limits, best: float) -> str:
    """Errors that 95 % of the frames stay below, and what is missed."""
    share = 100 / case.newton
    missed = limits.missed(errors)
    return (
        f"{case.name:20s} {case.newton:4g} | {share * errors.high('fz'):6.2f} "
        f"{share * errors.fz.mean():6.2f} {share * limits.fz:5.2f} | {errors.high('ft'):6.4f} "
        f"{limits.ft:6.4f} | {1e3 * errors.high('torque'):11.3f} | {100 * errors.high('l2'):5.1f} "
        f"{100 * limits.l2:5.0f} {100 * best:6.1f} | "
        f"{100 * np.mean(errors.area):6.0f} {np.mean(errors.contacts):8.2f} | "
        f"{'MISS ' + ', '.join(missed) if missed else 'OK'}"
    )
