"""Settings of the contact solver."""

from __future__ import annotations

from dataclasses import dataclass

from cmp_tactile_processing.sensor.parameters import Parameters, parameter

__all__ = ["ContactSettings"]


@dataclass(frozen=True)
class ContactSettings(Parameters, section="contact"):
    """How the contact is stepped and how well each step is solved."""

    step: float = parameter(
        2e-4,
        "longest way of any point of the indenter's contact in one step",
        unit="m",
        within=(1e-6, 1e-2),
    )
    min_step_share: float = parameter(
        1.0 / 64.0, "share of the first step below which it is not shortened", within=(1e-6, 1.0)
    )
    tolerance: float = parameter(
        1e-10,
        "how far gap and slip may miss their conditions where the iteration ends early",
        unit="m",
        within=(1e-12, 1e-6),
    )
    accepted: float = parameter(
        5e-8, "how far they may miss them at all", unit="m", within=(1e-12, 1e-4)
    )
    last_resort: float = parameter(
        5e-6,
        "how far they may miss them where no shorter step helps",
        unit="m",
        within=(1e-12, 1e-4),
    )
    flip_tolerance: float = parameter(
        1e-6,
        "how far a node that can neither stick nor slide may creep in one step",
        unit="m",
        within=(0.0, 1e-4),
    )
    defect: float = parameter(
        5e-8,
        "how far the solver's displacement may differ from a non-linear gel's",
        unit="m",
        within=(1e-12, 1e-6),
    )
    load_tolerance: float = parameter(
        1e-6, "how far a load may be missed, relative to the normal force", within=(1e-10, 1e-2)
    )
    iterations: int = parameter(30, "Newton iterations of one step", within=(3, 1000))
    corrections: int = parameter(
        40, "passes in which a non-linear gel's displacement is corrected", within=(1, 1000)
    )
