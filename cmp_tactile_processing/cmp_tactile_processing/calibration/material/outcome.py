"""What a material calibration found out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.outcome import Estimate, Finding, Severity
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

__all__ = ["LoadResult", "MaterialOutcome", "material_verdict"]


@dataclass(frozen=True)
class LoadResult:
    """One load: what the reference told and what the sensor shows, gel frame, N.

    reference, reference_std (3,): as given, NaN where not known.  before, after (3,): the force
    that ForceModel shows with the material before and after; after_std (3,): its standard
    deviation, of noise and of the material.  used: False where it was left out, with `reason`.
    """

    name: str
    reference: NDArray[np.float64]
    reference_std: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    after_std: NDArray[np.float64]
    used: bool = True
    reason: str = ""

    @property
    def residual_before(self) -> NDArray[np.float64]:
        """What the sensor showed too much, (3,) N."""
        return self.before - self.reference

    @property
    def residual_after(self) -> NDArray[np.float64]:
        """What the sensor shows too much with the new material, (3,) N."""
        return self.after - self.reference


@dataclass(frozen=True)
class MaterialOutcome:
    """A material, how well it is known, and what speaks against it.

    sensor: the description with the new material and its `elastomer.calibration` filled in; as it
    was, with no estimates, where no load could be used or the reference is another frame's.
    offset, offset_std (6,): zero offset of the reference sensor, force N and torque N m, as it
    reads too much; NaN where it was not fitted.
    verdict: one or two sentences for people.
    """

    method: str
    sensor: SensorDescription
    estimates: tuple[Estimate, ...]
    loads: tuple[LoadResult, ...]
    offset: NDArray[np.float64]
    offset_std: NDArray[np.float64]
    findings: tuple[Finding, ...] = ()
    verdict: str = ""

    @property
    def accepted(self) -> bool:
        """Whether nothing speaks against using it."""
        return not any(item.severity is Severity.ERROR for item in self.findings)

    @property
    def record(self) -> MaterialRecord | None:
        """What the description keeps of this calibration; None where nothing could be fitted."""
        return self.sensor.elastomer.calibration if self.estimates else None


def material_verdict(outcome: MaterialOutcome) -> str:
    """What an outcome comes to, in a sentence or two."""
    if not outcome.accepted:
        errors = [item.text for item in outcome.findings if item.severity is Severity.ERROR]
        return f"Not usable. {errors[0]}"
    record, elastomer = outcome.record, outcome.sensor.elastomer
    assert record is not None  # noqa: S101 - an accepted outcome has one
    held = f" Kept from the description: {', '.join(record.held)}." if record.held else ""
    return (
        f"Usable. E = {elastomer.young / 1e3:.4g} kPa, Poisson's ratio {elastomer.poisson:.4f}: "
        f"normal force is known to {record.normal_std:.1%}, sideways force to "
        f"{record.tangential_std:.1%}, from {record.samples} "
        f"load{'s' if record.samples != 1 else ''}.{held}"
    )
