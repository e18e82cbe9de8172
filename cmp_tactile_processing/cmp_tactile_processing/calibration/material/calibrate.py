"""Calibration of the gel's material: Young's modulus from loads that are known.

The force that the sensor shows goes with the modulus.  Poisson's ratio, thickness and shading layer
stay as the description has them; what that leaves open is in the error bar of every force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cmp_tactile_processing.cache.one_thread import one_thread
from cmp_tactile_processing.calibration.material import findings
from cmp_tactile_processing.calibration.material.loads import (
    LoadResult,
    LoadSample,
    MaterialOutcome,
    check_samples,
    material_verdict,
    sample_name,
)
from cmp_tactile_processing.calibration.material.options import MaterialOptions
from cmp_tactile_processing.calibration.material.scale import (
    PoissonDoubt,
    Readings,
    ScaleFit,
    fit_scale,
    poisson_doubt,
)
from cmp_tactile_processing.calibration.outcome import (
    Estimate,
    Finding,
    Progress,
    Severity,
    provenance,
    silent,
)
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.contact_regions import material_covariance
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

# Young's modulus counts as determined below this share of its prior deviation.
HELD_SHARE = 0.5
METHODS = ("weights", "force_sensor")
# Of the loads, this share may be wrong before nobody knows which ones are right.
MOST_WRONG = 1 / 3
UNKNOWN = np.full(3, np.nan)


def fit_material(  # noqa: PLR0913, PLR0917 - what is known, how well, who is informed, where it is kept
    sensor: SensorDescription,
    samples: Sequence[LoadSample],
    method: str,
    options: MaterialOptions | None = None,
    on_progress: Progress = silent,
    cache_dir: Path | None = None,
) -> MaterialOutcome:
    """Young's modulus of a sensor's gel from samples of known load.

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
    # Without the deviations of an earlier calibration.
    plain = replace(sensor, elastomer=replace(sensor.elastomer, calibration=None))
    with one_thread():
        on_progress("loading the elastic model", 0, 1)
        model = ForceModel(plain, cache_dir)
        on_progress("loading the elastic model", 1, 1)
        fields = [model.reconstruct(item.displacement, item.status) for item in samples]
        linear = ForceModel(
            replace(plain, force=replace(plain.force, large_press="off")), cache_dir
        )
        calibration = _Calibration(
            sensor, samples, fields, linear, method, options or MaterialOptions()
        )
        return calibration.outcome()


@dataclass
class _Calibration:
    """The loads on their way to an outcome; `reasons` says which ones were left out, and why."""

    sensor: SensorDescription
    samples: Sequence[LoadSample]
    fields: Sequence[ForceField]
    linear: ForceModel
    method: str
    options: MaterialOptions
    reasons: dict[int, str] = field(default_factory=dict)

    def outcome(self) -> MaterialOutcome:
        """Fit what can be fitted and say what is wrong."""
        self._leave_out_unseen()
        used = self._used
        if not used:
            text = "No load can be used: " + "; ".join(
                f"{self._name(k)}: {reason}" for k, reason in self.reasons.items()
            )
            advice = "Press harder, inside the marker area, and check the reference at rest."
            return self._nothing([Finding(Severity.ERROR, f"{text}.", advice)])
        readings = self._readings(used)
        wrong = findings.axis_findings(readings.shown, readings.reference)
        if wrong:
            return self._nothing(wrong)
        pressure = np.mean([np.abs(self.fields[k].force[:, 2]) for k in used], axis=0)
        doubt = poisson_doubt(self.sensor, self.linear, pressure, self.options.poisson)
        fit, contradiction = self._robust_fit(doubt)
        return self._fitted(fit, doubt, contradiction)

    @property
    def _used(self) -> list[int]:
        return [k for k in range(len(self.samples)) if k not in self.reasons]

    def _name(self, index: int) -> str:
        return sample_name(self.samples, index)

    def _leave_out_unseen(self) -> None:
        weak = {}
        for index, shown in enumerate(self.fields):
            if not np.isfinite(shown.wrench).all():
                self.reasons[index] = f"only {shown.valid_fraction:.0%} of the markers were seen"
            elif not shown.contact.any():
                self.reasons[index] = "the sensor measures no contact"
            else:
                signal = float(np.max(np.abs(shown.wrench[:3]) / shown.wrench_std[:3]))
                if signal < self.options.least_load:
                    weak[index] = "it is too small compared with the noise"
        self.reasons |= weak

    def _readings(self, used: Sequence[int]) -> Readings:
        return Readings(
            shown=np.array([self.fields[k].wrench[:3] for k in used]),
            shown_std=np.array([self.fields[k].wrench_std[:3] for k in used]),
            reference=np.array([self.samples[k].force for k in used], dtype=np.float64),
            reference_std=np.array([self.samples[k].std for k in used], dtype=np.float64),
        )

    def _robust_fit(self, doubt: PoissonDoubt) -> tuple[ScaleFit, list[Finding]]:
        """Fit, leaving out loads that contradict the others."""
        wrong, limit = 0, self.options.outlier
        has_offset = self.method == "force_sensor"
        while True:
            used = self._used
            fit = fit_scale(self._readings(used), self.options, doubt, has_offset=has_offset)
            worst = int(np.argmax(fit.misfits))
            misfit = float(fit.misfits[worst])
            if misfit <= limit:
                return fit, []
            wrong += 1
            if len(used) < 3 or wrong > MOST_WRONG * len(self.samples):
                return fit, [findings.misfit_finding(self._name(used[worst]), misfit, limit)]
            reason = f"it is {misfit:.0f} standard deviations from the fit of the others"
            self.reasons[used[worst]] = reason

    def _fitted(
        self, fit: ScaleFit, doubt: PoissonDoubt, contradiction: list[Finding]
    ) -> MaterialOutcome:
        chosen = [self.samples[k] for k in self._used]
        estimates = material_estimates(self.sensor, fit, doubt, self.options)
        young, layer, *_ = estimates
        normal_std, tangential_std = fit.force_std(doubt)
        record = MaterialRecord(
            method=self.method,
            samples=len(chosen),
            normal_std=normal_std,
            tangential_std=tangential_std,
            young_std=young.std / young.after if young.determined else float("nan"),
            **provenance(estimates),
        )
        elastomer = replace(
            self.sensor.elastomer,
            young=young.after,
            shading_layer=replace(self.sensor.elastomer.shading_layer, young=layer.after),
            calibration=record,
        )
        left_out = {self._name(k): why for k, why in self.reasons.items()}
        outcome = MaterialOutcome(
            method=self.method,
            sensor=replace(self.sensor, elastomer=elastomer),
            estimates=estimates,
            loads=self._results(fit.factor, (normal_std, tangential_std)),
            offset=fit.offset,
            offset_std=fit.offset_std,
            findings=(
                *contradiction,
                *findings.left_out_findings(left_out),
                *findings.offset_finding(fit.offset, fit.offset_std),
                *findings.range_findings(self.sensor, chosen, self.options),
                *findings.variety_findings(chosen, self.method),
                *findings.certainty_findings(normal_std, tangential_std, self.options),
            ),
        )
        return replace(outcome, verdict=material_verdict(outcome))

    def _results(
        self, factor: float = 1.0, material_std: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[LoadResult, ...]:
        """Of all samples.  factor: of the modulus; material_std: normal and sideways, relative."""
        results = []
        for k, (sample, shown) in enumerate(zip(self.samples, self.fields, strict=True)):
            after = factor * shown.wrench
            covariance = factor**2 * shown.wrench_covariance
            covariance = covariance + material_covariance(after, np.zeros(3), *material_std)
            results.append(
                LoadResult(
                    name=self._name(k),
                    reference=np.asarray(sample.force, dtype=np.float64),
                    reference_std=np.asarray(sample.std, dtype=np.float64),
                    before=shown.wrench[:3],
                    after=after[:3],
                    after_std=np.sqrt(np.diag(covariance)[:3]),
                    used=k not in self.reasons,
                    reason=self.reasons.get(k, ""),
                )
            )
        return tuple(results)

    def _nothing(self, wrong: list[Finding]) -> MaterialOutcome:
        """The outcome where nothing was fitted: the description as it is."""
        return MaterialOutcome(
            method=self.method,
            sensor=self.sensor,
            estimates=(),
            loads=self._results(),
            offset=UNKNOWN,
            offset_std=UNKNOWN,
            findings=tuple(wrong),
            verdict=f"Not usable. {wrong[0].text}",
        )


def material_estimates(
    sensor: SensorDescription, fit: ScaleFit, doubt: PoissonDoubt, options: MaterialOptions
) -> tuple[Estimate, ...]:
    """Estimates of both moduli, then of what was kept.

    The shading layer's modulus keeps its ratio to the gel's, which no load determines.
    """
    gel = sensor.elastomer
    layer = gel.shading_layer
    std, _ = fit.force_std(doubt)
    determined = std <= HELD_SHARE * np.log(options.young_factor) / 2
    young, layer_young = (fit.factor * value for value in (gel.young, layer.young))
    kept = (
        ("poisson", "", gel.poisson, options.poisson),
        ("size[2]", "m", gel.size[2], 0.0),
        ("shading_layer.thickness", "m", layer.thickness, 0.0),
    )
    return (
        Estimate("elastomer.young", "Pa", gel.young, young, std * young, determined),
        Estimate(
            "elastomer.shading_layer.young",
            "Pa",
            layer.young,
            layer_young,
            std * layer_young,
            determined=False,
        ),
        *(
            Estimate(f"elastomer.{name}", unit, value, value, deviation, determined=False)
            for name, unit, value, deviation in kept
        ),
    )
