"""Calibration of the gel's material: moduli from loads that are known.

How far the markers move under a known force shows Young's modulus; how the movement spreads beside
the contact, and how much further it goes sideways, show Poisson's ratio and the shading layer.
What the loads do not show keeps what the description says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.blas_threads import one_blas_thread
from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily, MaterialOptions
from cmp_tactile_processing.calibration.material.findings import (
    axis_findings,
    certainty_findings,
    left_out_findings,
    material_estimates,
    material_record,
    misfit_finding,
    offset_finding,
    range_findings,
    variety_findings,
)
from cmp_tactile_processing.calibration.material.fit import (
    Load,
    LoadInverse,
    MaterialFit,
    fit_loads,
    force_deviations,
)
from cmp_tactile_processing.calibration.material.loads import (
    LoadResult,
    LoadSample,
    MaterialOutcome,
    Readings,
    check_samples,
    force_std,
    material_verdict,
    sample_name,
    strain_corrected,
)
from cmp_tactile_processing.calibration.outcome import Finding, Progress, Severity, silent
from cmp_tactile_processing.elastic.equilibrium import NoEquilibriumError
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.large_press import LargePress, settle
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

METHODS = ("weights", "force_sensor")
# Of the loads, this share may be wrong before nobody knows which ones are right.
MOST_WRONG = 1 / 3


def fit_material(  # noqa: PLR0913, PLR0917 - what is known, how well, who is informed, where it is kept
    sensor: SensorDescription,
    samples: Sequence[LoadSample],
    method: str,
    options: MaterialOptions | None = None,
    on_progress: Progress = silent,
    cache_dir: Path | None = None,
) -> MaterialOutcome:
    """The material of a sensor's gel from samples of known load.

    method: "weights", or "force_sensor" with a zero that may be off, which is then fitted too.
    cache_dir: see ElasticModel.  Samples are of a gel at rest under its load; creep is taken out
    before, see RelaxationFilter.  What is wrong with loads or result is among the findings.
    Raises CalibrationError for no samples, samples of another shape or without a known force, and
    for another method.
    """
    if method not in METHODS:
        msg = f"{sensor.name}: method: found {method!r}, expected {' or '.join(METHODS)}"
        raise CalibrationError(msg)
    check_samples(sensor, samples)
    with one_blas_thread():
        return _Calibration(
            sensor, samples, method, options or MaterialOptions(), on_progress, cache_dir
        ).outcome()


@dataclass
class _Calibration:
    """The loads on their way to an outcome; `reasons` says which ones were left out, and why."""

    sensor: SensorDescription
    samples: Sequence[LoadSample]
    method: str
    options: MaterialOptions
    on_progress: Progress
    cache_dir: Path | None
    reasons: dict[int, str] = field(default_factory=dict)
    _large: LargePress | None = None

    def outcome(self) -> MaterialOutcome:
        """Fit what can be fitted and say what is wrong."""
        self.on_progress("loading the elastic model", 0, 1)
        model = self._model(self.sensor)
        self.on_progress("loading the elastic model", 1, 1)
        fields = [model.reconstruct(item.displacement, item.status) for item in self.samples]
        loads = self._loads(model, fields)
        used = self._used
        if not used:
            text = "No load can be used: " + "; ".join(
                f"{self._name(k)}: {reason}" for k, reason in self.reasons.items()
            )
            advice = "Press harder, inside the marker area, and check the reference at rest."
            return self._nothing(fields, [Finding(Severity.ERROR, f"{text}.", advice)])
        wrong = axis_findings(
            np.array([fields[k].wrench[:3] for k in used]),
            np.array([self.samples[k].force for k in used], dtype=np.float64),
        )
        if wrong:
            return self._nothing(fields, wrong)
        family = ComplianceFamily(
            self.sensor,
            model.elastic,
            self.options,
            cache_dir=self.cache_dir,
            on_progress=self.on_progress,
        )
        fit, findings = self._robust_fit(family, loads)
        return self._fitted(family, loads, fit, fields, findings)

    def _model(self, sensor: SensorDescription) -> ForceModel:
        """ForceModel without the deviations of an earlier calibration of the material."""
        plain = replace(sensor, elastomer=replace(sensor.elastomer, calibration=None))
        return ForceModel(plain, self.cache_dir)

    @property
    def _used(self) -> list[int]:
        return [k for k in range(len(self.samples)) if k not in self.reasons]

    def _name(self, index: int) -> str:
        return sample_name(self.samples, index)

    def _loads(self, model: ForceModel, fields: Sequence[ForceField]) -> dict[int, Load]:
        """The loads that show, by number."""
        loads = {}
        for index, (sample, shown) in enumerate(zip(self.samples, fields, strict=True)):
            if not np.isfinite(shown.wrench).all():
                self.reasons[index] = f"only {shown.valid_fraction:.0%} of the markers were seen"
            elif not shown.contact.any():
                self.reasons[index] = "the sensor shows no contact"
            else:
                try:
                    linear = self._linear_part(sample, shown, model)
                except NoEquilibriumError:
                    self.reasons[index] = "it is larger than the gel can follow"
                    continue
                inverse = LoadInverse(linear, shown, model.elastic, self.sensor)
                loads[index] = Load(inverse, sample.reference, sample.reference_std)
        return loads

    def _linear_part(self, sample: LoadSample, shown: ForceField, model: ForceModel) -> LoadSample:
        """The sample as a linear gel would show it: large strain goes with force over modulus.

        So it is the same for every Young's modulus, and hardly another for another shape.
        """
        if not strain_corrected(self.sensor):
            return sample
        if self._large is None:
            self._large = LargePress(
                ElasticProblem.from_sensor(self.sensor), self.sensor.elastomer.young, self.cache_dir
            )
        self._large.reset()
        if shown.corrected:
            return replace(
                sample, displacement=sample.displacement - self._large.excess(shown.force)
            )
        settle(
            lambda moved: model.reconstruct(moved, sample.status).force,
            self._large.excess,
            np.asarray(sample.displacement),
        )
        return replace(sample, displacement=sample.displacement - self._large.latest)

    def _robust_fit(
        self, family: ComplianceFamily, loads: dict[int, Load]
    ) -> tuple[MaterialFit, list[Finding]]:
        """Fit, leaving out loads that are too small or that contradict the others."""
        parameters, rounds = self.options, len(self.samples)
        offsets = np.zeros(6)
        if self.method == "force_sensor":
            torque = any(np.isfinite(sample.torque).any() for sample in self.samples)
            offsets[:3] = parameters.offset
            offsets[3:] = parameters.torque_offset if torque else 0.0
        for done in range(rounds):
            self.on_progress("fitting the material", done, rounds)
            used = self._used
            young = self.sensor.elastomer.young
            fit = fit_loads(family, [loads[k] for k in used], parameters, young, offsets)
            weak = [used[k] for k in np.flatnonzero(fit.signal < parameters.least_load)]
            worst = used[int(np.argmax(fit.misfits))]
            misfit = float(fit.misfits.max())
            if weak and len(weak) < len(used):
                for k in weak:
                    self.reasons[k] = "it is too small to stand out of the noise"
                continue
            if misfit <= parameters.outlier:
                break
            wrong = sum("off" in reason for reason in self.reasons.values()) + 1
            if len(used) < 3 or wrong > MOST_WRONG * len(self.samples):
                finding = misfit_finding(self._name(worst), misfit, parameters.outlier)
                return fit, [finding]
            self.reasons[worst] = f"it is {misfit:.0f} standard deviations off what the others show"
        self.on_progress("fitting the material", rounds, rounds)
        return fit, []

    def _fitted(
        self,
        family: ComplianceFamily,
        loads: dict[int, Load],
        fit: MaterialFit,
        fields: Sequence[ForceField],
        findings: list[Finding],
    ) -> MaterialOutcome:
        used = self._used
        chosen = [self.samples[k] for k in used]
        after, factor = self._after(family, fit, fields)
        readings = Readings.from_samples(chosen, [after[k] for k in used], fit.offset, factor)
        scale = readings.scale(self.options.model_error)
        spread = readings.spread(scale)
        fit, factor = fit.scaled(scale, spread[0]), factor * scale
        normal, tangential = force_deviations(family, [loads[k] for k in used], fit)
        tangential = float(np.hypot(tangential, spread[1]))
        estimates = material_estimates(self.sensor, family, fit)
        material = family.shape(fit.shape).applied_to(self.sensor.elastomer, fit.young)
        record = material_record(self.method, len(used), estimates, (normal, tangential))
        sensor = replace(self.sensor, elastomer=replace(material, calibration=record))
        offset, offset_std = _offset(fit)
        findings = [
            *findings,
            *left_out_findings({self._name(k): why for k, why in self.reasons.items()}),
            *(offset_finding(offset, offset_std)),
            *range_findings(self.sensor, chosen, self.options),
            *variety_findings(chosen, record.held, self.method),
            *certainty_findings(normal, tangential, self.options),
        ]
        outcome = MaterialOutcome(
            method=self.method,
            sensor=sensor,
            estimates=estimates,
            loads=self._results(fields, after, factor, record),
            offset=offset,
            offset_std=offset_std,
            findings=tuple(findings),
        )
        return replace(outcome, verdict=material_verdict(outcome))

    def _after(
        self, family: ComplianceFamily, fit: MaterialFit, before: Sequence[ForceField]
    ) -> tuple[Sequence[ForceField], float]:
        """What ForceModel shows of the samples with the fitted shape, and factor to E of the fit.

        Forces go with Young's modulus, so where nothing else has changed they are known.
        """
        if np.array_equal(fit.shape, family.start):
            return before, fit.young / self.sensor.elastomer.young
        material = family.shape(fit.shape).applied_to(self.sensor.elastomer, fit.young)
        self.on_progress("building the elastic model of the new material", 0, 1)
        model = self._model(replace(self.sensor, elastomer=material))
        after = [model.reconstruct(item.displacement, item.status) for item in self.samples]
        self.on_progress("building the elastic model of the new material", 1, 1)
        return after, 1.0

    def _results(
        self,
        before: Sequence[ForceField],
        after: Sequence[ForceField],
        factor: float = 1.0,
        record: MaterialRecord | None = None,
    ) -> tuple[LoadResult, ...]:
        """Of all samples; factor: of the modulus since the fields `after` were made."""
        stds = (record.normal_std, record.tangential_std) if record else (0.0, 0.0)
        return tuple(
            LoadResult(
                name=self._name(k),
                reference=np.asarray(sample.force, dtype=np.float64),
                reference_std=np.asarray(sample.std, dtype=np.float64),
                before=before[k].wrench[:3],
                after=factor * after[k].wrench[:3],
                after_std=force_std(after[k], factor, *stds),
                used=k not in self.reasons,
                reason=self.reasons.get(k, ""),
            )
            for k, sample in enumerate(self.samples)
        )

    def _nothing(self, fields: Sequence[ForceField], findings: list[Finding]) -> MaterialOutcome:
        """The outcome where nothing was fitted: the description as it is."""
        unknown = np.full(6, np.nan)
        return MaterialOutcome(
            method=self.method,
            sensor=self.sensor,
            estimates=(),
            loads=self._results(fields, fields),
            offset=unknown,
            offset_std=unknown,
            findings=tuple(findings),
            verdict=f"Not usable. {findings[0].text}",
        )


def _offset(fit: MaterialFit) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    std = np.full(6, np.nan)
    fitted = np.isfinite(fit.offset)
    if fitted.any():
        std[fitted] = np.sqrt(np.diag(fit.covariance)[-int(fitted.sum()) :])
    return fit.offset, std
