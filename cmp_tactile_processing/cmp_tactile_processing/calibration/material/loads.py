"""Known loads: as they are given, as the force stage shows them, and what came of them.

The fit has an inverse of its own.  What counts in the end is what ForceModel shows, which goes with
Young's modulus, so the modulus is set by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.outcome import Estimate, Finding, WithFindings, errors_in
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.contact_regions import material_covariance
from cmp_tactile_processing.measured import ForceField, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

# Components of a load below this share of it say nothing of relative errors.
LEAST_SHARE = 0.1


def _unknown() -> NDArray[np.float64]:
    return np.full(3, np.nan)


@dataclass(frozen=True)
class LoadSample:
    """Displacement of the markers, of one frame or averaged over some, under a known load.

    displacement (rows, cols, 3) m and status (rows, cols) as ForceModel takes them.
    force (3,) N: on the gel, gel frame, so that a press has negative z; NaN in components that are
    not known.  std (3,) N: standard deviations of its known components.
    torque (3,) N m: moment on the gel about the gel frame's origin, with torque_std (3,).
    name: how findings call it, such as "200 g"; its number where empty.
    """

    displacement: NDArray[np.float64]
    status: NDArray[np.uint8]
    force: NDArray[np.float64]
    std: NDArray[np.float64]
    torque: NDArray[np.float64] = field(default_factory=_unknown)
    torque_std: NDArray[np.float64] = field(default_factory=_unknown)
    name: str = ""

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the load's marker displacements are known, (rows, cols, 3)."""
        seen = np.asarray(self.status) != Status.MISSING
        return np.asarray(np.isfinite(self.displacement) & seen[..., None])

    @property
    def reference(self) -> NDArray[np.float64]:
        """Force and torque, (6,) N and N m."""
        return np.concatenate([self.force, self.torque]).astype(np.float64)

    @property
    def reference_std(self) -> NDArray[np.float64]:
        """Standard deviations of `reference`, (6,)."""
        return np.concatenate([self.std, self.torque_std]).astype(np.float64)


def sample_name(samples: Sequence[LoadSample], index: int) -> str:
    """How a sample is called in texts: "load 2", "load 3 (200 g)"."""
    name = samples[index].name
    return f"load {index + 1} ({name})" if name else f"load {index + 1}"


def strain_corrected(sensor: SensorDescription) -> bool:
    """Whether ForceModel takes out what large strain does to this gel."""
    choice = sensor.force.large_press
    return choice == "on" or (choice == "auto" and sensor.elastomer.model == "neo_hookean")


def check_samples(sensor: SensorDescription, samples: Sequence[LoadSample]) -> None:
    """Raise CalibrationError for samples that cannot be of this sensor, or that give no load."""
    if not samples:
        msg = f"{sensor.name}: samples: found none, expected at least one known load"
        raise CalibrationError(msg)
    rows, cols = sensor.pattern.rows, sensor.pattern.cols
    shapes = {"displacement": (rows, cols, 3), "status": (rows, cols)}
    shapes |= dict.fromkeys(("force", "std", "torque", "torque_std"), (3,))
    for index, sample in enumerate(samples):
        where = f"{sensor.name}: {sample_name(samples, index)}"
        for key, expected in shapes.items():
            found = np.shape(getattr(sample, key))
            if found != expected:
                msg = f"{where}: {key}: found shape {found}, expected {expected}"
                raise CalibrationError(msg)
        _check_reference(where, sample)


def _check_reference(where: str, sample: LoadSample) -> None:
    for key, std_key in (("force", "std"), ("torque", "torque_std")):
        value, std = np.asarray(getattr(sample, key)), np.asarray(getattr(sample, std_key))
        if np.isinf(value).any():
            msg = f"{where}: {key}: found {_text(value)}, expected numbers, or NaN where not known"
            raise CalibrationError(msg)
        known = np.isfinite(value)
        if not (np.isfinite(std[known]) & (std[known] > 0)).all():
            msg = (
                f"{where}: {std_key}: found {_text(std)}, expected a number above 0 for every "
                f"known component of {key} {_text(value)}"
            )
            raise CalibrationError(msg)
    if not np.isfinite(sample.force).any():
        msg = f"{where}: force: found {_text(sample.force)}, expected one known component or more"
        raise CalibrationError(msg)


def _text(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


@dataclass(frozen=True)
class LoadResult:
    """One load: what the reference gave and what the sensor shows, gel frame, N.

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
class MaterialOutcome(WithFindings):
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
        f"Usable. E = {elastomer.young / 1e3:.4g} kPa, Poisson's ratio {elastomer.poisson:.4f}: "
        f"normal force is known to {record.normal_std:.1%}, sideways force to "
        f"{record.tangential_std:.1%}, from {record.samples} "
        f"load{'s' if record.samples != 1 else ''}.{held}"
    )


@dataclass(frozen=True)
class Readings:
    """Forces that ForceModel shows of some loads, of a modulus that may still be changed.

    shown, reference (n, 3) N: the reference without its offset, NaN where not known.  std (n, 3) N:
    of their difference, from the reference and the noise of the markers.
    """

    shown: NDArray[np.float64]
    reference: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def from_samples(
        cls,
        samples: Sequence[LoadSample],
        fields: Sequence[ForceField],
        offset: NDArray[np.float64],
        factor: float = 1.0,
    ) -> Readings:
        """Of samples and their fields; factor: of the modulus since these were made."""
        return cls(
            shown=factor * np.array([field.wrench[:3] for field in fields]),
            reference=np.array([sample.force for sample in samples]) - np.nan_to_num(offset[:3]),
            std=np.hypot(
                np.array([sample.std for sample in samples]),
                factor * np.array([field.wrench_std[:3] for field in fields]),
            ),
        )

    def scale(self, model_error: float) -> float:
        """By what the modulus is to be multiplied for the loads to be shown right on the whole.

        The larger component of a load says most, mostly the normal one.
        """
        size = np.linalg.norm(np.nan_to_num(self.reference), axis=1, keepdims=True)
        weight = np.nan_to_num(1 / (self.std**2 + (model_error * size) ** 2))
        reference = np.nan_to_num(self.reference)
        return float((weight * self.shown * reference).sum() / (weight * self.shown**2).sum())

    def spread(self, scale: float) -> tuple[float, float]:
        """Relative deviations of normal and tangential force from one load to another.

        Without what `std` explains; 0 where no load shows them.
        """
        off = scale * self.shown - self.reference
        size = np.linalg.norm(np.nan_to_num(self.reference), axis=1)
        parts = []
        # One of the normal forces is as good as used up: the modulus makes it right.
        for axes, used in ((slice(2, 3), 1), (slice(0, 2), 0)):
            known = np.isfinite(self.reference[:, axes]).all(axis=1)
            force = np.linalg.norm(self.reference[known, axes], axis=1)
            large = force > LEAST_SHARE * size[known]
            relative = (off[known, axes] ** 2 - self.std[known, axes] ** 2).sum(axis=1)[large]
            count = int(large.sum()) - used
            total = float((relative / force[large] ** 2).sum())
            parts.append(np.sqrt(max(0.0, total) / count) if count > 0 else 0.0)
        return float(parts[0]), float(parts[1])


def force_std(
    field: ForceField, factor: float, normal: float, tangential: float
) -> NDArray[np.float64]:
    """Deviations (3,) of the force of a field made without a calibration record, N.

    factor: of the modulus since; normal, tangential: relative deviations that the record adds.
    """
    wrench = factor * field.wrench
    covariance = factor**2 * field.wrench_covariance
    covariance = covariance + material_covariance(wrench, np.zeros(3), normal, tangential)
    return np.asarray(np.sqrt(np.diag(covariance)[:3]))
