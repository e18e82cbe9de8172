"""Known loads: as they are given, as the sensor shows them, and what came of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.outcome import Estimate, WithFindings
from cmp_tactile_processing.errors import CalibrationError, Finding, errors_in
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord


@dataclass(frozen=True)
class LoadSample:
    """Displacement of the markers, of one frame or averaged over some, under a known load.

    displacement (rows, cols, 3) m and status (rows, cols) as ForceModel takes them.
    force (3,) N: on the gel, gel frame, so that a press has negative z; NaN in components that are
    not known.  std (3,) N: standard deviations of its known components.
    name: how findings call it, such as "200 g"; its number where empty.
    """

    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]
    force: NDArray[np.float64]
    std: NDArray[np.float64]
    name: str = ""


def sample_name(samples: Sequence[LoadSample], index: int) -> str:
    """How a sample is called in texts: "load 2", "load 3 (200 g)"."""
    name = samples[index].name
    return f"load {index + 1} ({name})" if name else f"load {index + 1}"


def check_views(sensor: SensorDescription) -> None:
    """Raise CalibrationError for a sensor with one view, which cannot measure a normal force."""
    if len(sensor.views) == 1:
        msg = (
            f"{sensor.name}: views: found one view, expected two to calibrate forces. One view "
            "shows displacement in the plane, shear and where a contact is. It does not show "
            "depth: the normal force is inferred with a standard deviation of 100 %, which no "
            "load makes smaller. Set elastomer.young from the data sheet of the gel, or add a "
            "second view"
        )
        raise CalibrationError(msg)


def check_samples(sensor: SensorDescription, samples: Sequence[LoadSample]) -> None:
    """Raise CalibrationError for samples that cannot be of this sensor, or that give no load."""
    check_views(sensor)
    if not samples:
        msg = f"{sensor.name}: samples: found none, expected at least one known load"
        raise CalibrationError(msg)
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    shapes = {"displacement": (rows, cols, 3), "status": (rows, cols)}
    shapes |= dict.fromkeys(("force", "std"), (3,))
    for index, sample in enumerate(samples):
        where = f"{sensor.name}: {sample_name(samples, index)}"
        for key, expected in shapes.items():
            found = np.shape(getattr(sample, key))
            if found != expected:
                msg = f"{where}: {key}: found shape {found}, expected {expected}"
                raise CalibrationError(msg)
        _check_reference(where, sample)


def _check_reference(where: str, sample: LoadSample) -> None:
    force, std = np.asarray(sample.force), np.asarray(sample.std)
    known = np.isfinite(force)
    if np.isinf(force).any() or not known.any():
        msg = (
            f"{where}: force: found {_text(force)}, expected numbers, or NaN for unknown components"
        )
        raise CalibrationError(msg)
    if not (np.isfinite(std[known]) & (std[known] > 0)).all():
        msg = (
            f"{where}: std: found {_text(std)}, expected a number above 0 for every known "
            f"component of force {_text(force)}"
        )
        raise CalibrationError(msg)


def _text(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


@dataclass(frozen=True)
class LoadResult:
    """One load: what the reference gave and what the sensor shows, gel frame, N.

    reference, reference_std (3,): as given, NaN where not known.  before, after (3,): the force
    that ForceModel shows with the material before and after; after_std (3,): its standard
    deviation, of noise and of the material.  reason: why it was left out, empty where it was used.
    """

    name: str
    reference: NDArray[np.float64]
    reference_std: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    after_std: NDArray[np.float64]
    reason: str = ""

    @property
    def used(self) -> bool:
        """Whether it counted in the fit."""
        return not self.reason

    @property
    def residual_after(self) -> NDArray[np.float64]:
        """What the sensor shows too much with the new material, (3,) N."""
        return self.after - self.reference


@dataclass(frozen=True)
class MaterialOutcome(WithFindings):
    """A material, how well it is known, and what speaks against it.

    sensor: the description with the new material and its `elastomer.calibration` filled in; as it
    was, with no estimates, where no load could be used or the reference is another frame's.
    offset, offset_std (3,): zero offset of the reference sensor, N, as it reads too much; NaN where
    it was not fitted.
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
    def record(self) -> MaterialRecord | None:
        """What the description keeps of this calibration; None where nothing could be fitted."""
        return self.sensor.elastomer.calibration if self.estimates else None


def material_verdict(outcome: MaterialOutcome) -> str:
    """What an outcome comes to, in a sentence or two."""
    if not outcome.accepted:
        errors = errors_in(outcome.findings)
        return f"Not usable. {errors[0].text}"
    record, elastomer = outcome.record, outcome.sensor.elastomer
    assert record is not None  # noqa: S101 - an accepted outcome has one
    held = f" Kept from the description: {', '.join(record.held)}." if record.held else ""
    return (
        f"Usable. E = {elastomer.young / 1e3:.4g} kPa, Poisson's ratio {elastomer.poisson:.4f}. "
        f"Standard deviation of the normal force {record.normal_std:.1%}, of the sideways force "
        f"{record.tangential_std:.1%}, from {record.samples} "
        f"load{'s' if record.samples != 1 else ''}.{held}"
    )
