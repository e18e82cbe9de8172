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
from cmp_tactile_processing.calibration.outcome import (
    Estimate,
    Finding,
    Progress,
    Severity,
    provenance,
    silent,
)
from cmp_tactile_processing.elastic.equilibrium import NoEquilibriumError
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.force.large_press import LargePress, settle
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

# Young's modulus is always fitted; it counts as determined below this share of its prior deviation.
HELD_SHARE = 0.5
# A correlation as strong as this is that of the same axis.
ALIKE = 0.8
# A reference that is turned by more than this about z, rad, was not turned into the gel frame.
LARGEST_TURN = np.radians(20)
# By so much must the mirrored reference resemble the sensor's forces more.
CLEARLY_MIRRORED = 0.03
# Loads that differ by less than this factor say as much as one.
LEAST_RANGE = 1.5
# Sideways force below this share of the normal force says nothing of Poisson's ratio.
LEAST_SIDEWAYS = 0.1
# Standard deviations beyond which an offset is there.
CLEAR = 3.0
MOST_LISTED = 6
# Taken as linear, a rubber-like gel that is pressed in by 2.3 % of its thickness shows 4 % too much
# or too little force; the error grows with the depth.
STRAIN_ERROR = 0.04 / 0.023
METHODS = ("weights", "force_sensor")
# Of the loads, this share may be wrong before nobody knows which ones are right.
MOST_WRONG = 1 / 3


def material_estimates(
    sensor: SensorDescription, family: ComplianceFamily, fit: MaterialFit
) -> tuple[Estimate, ...]:
    """Estimates of all values of the material, those that were not fitted included.

    The shading layer's modulus keeps its ratio to the gel's where the loads do not show it, so it
    changes with the gel's, and counts as determined only where that ratio is.
    """
    before = sensor.elastomer
    after = family.shape(fit.shape).applied_to(before, fit.young)
    std = np.sqrt(np.diag(fit.covariance))
    spread = {"young": float(std[0])}
    determined = {"young": bool(fit.open_share[0] <= HELD_SHARE)}
    for k, name in enumerate(family.names):
        spread[name], determined[name] = float(std[1 + k]), not bool(fit.held[k])
    ratio = family.names.index("layer_ratio") + 1 if "layer_ratio" in family.names else None
    layer_std = spread["young"]
    if ratio is not None:
        both = np.ix_([0, ratio], [0, ratio])
        layer_std = float(np.sqrt(fit.covariance[both].sum()))
    old, new = before.shading_layer, after.shading_layer
    thickness = after.size[2] * spread.get("thickness", 0.0)
    rows = [
        ("young", "young", "Pa", before.young, after.young, after.young * spread["young"]),
        ("poisson", "poisson", "", before.poisson, after.poisson, spread.get("poisson", 0.0)),
        ("thickness", "size[2]", "m", before.size[2], after.size[2], thickness),
    ]
    if old.thickness > 0:
        layer = new.thickness * spread.get("layer_thickness", 0.0)
        key, name = "layer_thickness", "shading_layer.thickness"
        rows.append((key, name, "m", old.thickness, new.thickness, layer))
        layer = new.young * layer_std
        rows.append(("layer_ratio", "shading_layer.young", "Pa", old.young, new.young, layer))
    return tuple(
        Estimate(f"elastomer.{name}", unit, one, other, deviation, determined.get(key, False))
        for key, name, unit, one, other, deviation in rows
    )


def material_record(
    method: str, samples: int, estimates: Sequence[Estimate], force_std: tuple[float, float]
) -> MaterialRecord:
    """What a description keeps of the estimates; force_std: relative, normal and tangential."""
    known = {item.name: item for item in estimates}
    young, poisson = known["elastomer.young"], known["elastomer.poisson"]
    return MaterialRecord(
        method=method,
        samples=samples,
        normal_std=force_std[0],
        tangential_std=force_std[1],
        young_std=young.std / young.after if young.determined else float("nan"),
        poisson_std=poisson.std if poisson.determined else float("nan"),
        **provenance(estimates),
    )


def axis_findings(shown: NDArray[np.float64], given: NDArray[np.float64]) -> list[Finding]:
    """Does the reference point where the sensor does?  shown, given (n, 3) N; given may be NaN."""
    advice = (
        "Forces are those on the gel in the gel frame: z points out of the gel, so that a press is "
        "negative. Turn the reference into that frame."
    )
    scale = np.abs(given[np.isfinite(given)]).max()
    if _likeness(shown[:, 2], given[:, 2], scale) < -ALIKE:
        text = (
            "The reference has the other sign: the sensor shows a force along z of "
            f"{_listed(shown[:, 2])} N where the reference gives {_listed(given[:, 2])} N."
        )
        return [Finding(Severity.ERROR, text, advice)]
    known = np.isfinite(given[:, :2]).all(axis=1)
    a, b = (values[known, 0] + 1j * values[known, 1] for values in (shown, given))
    power = np.sqrt((np.abs(a) ** 2).sum() * (np.abs(b) ** 2).sum())
    if not power > (LEAST_SIDEWAYS * scale) ** 2:
        return []
    turned, mirrored = np.vdot(a, b), np.vdot(np.conj(a), b)
    how, product = "", turned
    # Loads of one direction look turned as well as mirrored.
    if abs(mirrored) > abs(turned) + CLEARLY_MIRRORED * power:
        how, product = "mirrored and ", mirrored
    turn = float(np.angle(product))
    if abs(product) <= ALIKE * power or (not how and abs(turn) <= LARGEST_TURN):
        return []
    text = (
        f"The reference's x and y axes are {how}turned by {np.degrees(turn):+.0f} degrees about z "
        "against the gel frame's: its sideways forces point elsewhere than the sensor's."
    )
    return [Finding(Severity.ERROR, text, advice)]


def _likeness(a: NDArray[np.float64], b: NDArray[np.float64], scale: float) -> float:
    known = np.isfinite(b)
    power = float(np.sqrt((a[known] ** 2).sum() * (b[known] ** 2).sum()))
    return float(a[known] @ b[known]) / power if power > (1e-3 * scale) ** 2 else 0.0


def _listed(values: NDArray[np.float64]) -> str:
    listed = ", ".join(f"{value:.3g}" for value in values[:MOST_LISTED])
    return f"{listed}, ..." if len(values) > MOST_LISTED else listed


def left_out_findings(reasons: dict[str, str]) -> list[Finding]:
    """Which loads were left out?  reasons: by name of the load."""
    advice = "Look at it, correct it or give it again: it changes nothing as it is."
    return [
        Finding(Severity.WARNING, f"{name[0].upper()}{name[1:]} was left out: {reason}.", advice)
        for name, reason in reasons.items()
    ]


def misfit_finding(worst: str, misfit: float, limit: float) -> Finding:
    """The loads contradict one another."""
    text = (
        f"The loads contradict one another: no material fits them all, {worst} is {misfit:.1f} "
        f"standard deviations off (limit {limit:g})."
    )
    advice = (
        "Are the values of the loads right, and was each one at rest? Give loads that are known to "
        "be right, or larger standard deviations."
    )
    return Finding(Severity.ERROR, text, advice)


def offset_finding(offset: NDArray[np.float64], std: NDArray[np.float64]) -> list[Finding]:
    """Does the reference sensor read something where nothing is?"""
    clear = np.abs(offset[:3]) > CLEAR * std[:3]
    if not clear.any():
        return []
    values = ", ".join(
        f"{offset[k]:+.3g} N along {axis}" for k, axis in enumerate("xyz") if clear[k]
    )
    text = f"The reference sensor has an offset: it reads {values} too much. It was taken out."
    return [Finding(Severity.WARNING, text, "Set the reference sensor to zero before the loads.")]


def range_findings(
    sensor: SensorDescription, samples: Sequence[LoadSample], options: MaterialOptions
) -> list[Finding]:
    """Were loads so large that a linear gel is a poor model, and is used as one?"""
    if strain_corrected(sensor):
        return []
    depth = max(float(np.nanmax(np.abs(sample.displacement[..., 2]))) for sample in samples)
    share = depth / sensor.elastomer.size[2]
    error = STRAIN_ERROR * share
    if error <= options.strain_error:
        return []
    text = (
        f"Loads press the gel in by up to {depth * 1e3:.2g} mm, {share:.1%} of its thickness, and "
        f"it is taken as linear: if it is rubber-like, forces are wrong by up to {error:.0%} "
        f"(limit {options.strain_error:.0%})."
    )
    deep = options.strain_error / STRAIN_ERROR * sensor.elastomer.size[2]
    return [Finding(Severity.WARNING, text, _strain_advice(sensor, deep))]


def _strain_advice(sensor: SensorDescription, depth: float) -> str:
    less = f"or use loads that press less than {depth * 1e3:.2g} mm deep."
    if sensor.elastomer.model == "neo_hookean":
        return f"Do not switch force.large_press off, {less}"
    return f"Say elastomer.model: neo_hookean of a silicone gel, which corrects for it, {less}"


def variety_findings(
    samples: Sequence[LoadSample], held: Sequence[str], method: str
) -> list[Finding]:
    """Do the loads differ enough to show what they should?"""
    findings = []
    sizes = np.array([np.linalg.norm(np.nan_to_num(sample.force)) for sample in samples])
    if len(samples) == 1:
        text, advice = "There is one load only: nothing shows whether it is right.", _MORE
        findings.append(Finding(Severity.WARNING, text, advice))
    elif sizes.max() < LEAST_RANGE * sizes.min():
        text = f"All loads are alike, {sizes.min():.3g} to {sizes.max():.3g} N: "
        text += (
            "an offset of the reference cannot be separated from the modulus."
            if method == "force_sensor"
            else "an error that grows with the load, or does not, shows nowhere."
        )
        findings.append(Finding(Severity.WARNING, text, _MORE))
    forces = np.array([np.nan_to_num(sample.force) for sample in samples])
    sideways = np.linalg.norm(forces[:, :2], axis=1) > LEAST_SIDEWAYS * np.abs(forces[:, 2])
    if not sideways.any():
        hangs = (
            "Poisson's ratio and with it the sideways force hang on what was known before"
            if "elastomer.poisson" in held
            else "Poisson's ratio hangs on how the gel moves beside the contact alone"
        )
        text = f"Only presses were given: {hangs}."
        advice = "Give a sideways load too: a weight on the tilted sensor, or a sideways pull."
        findings.append(Finding(Severity.WARNING, text, advice))
    return findings


_MORE = "Give three loads or more over the range in which the sensor is used."


def certainty_findings(normal: float, tangential: float, options: MaterialOptions) -> list[Finding]:
    """Is the force known well enough with this material?"""
    findings = []
    for name, std in (("normal", normal), ("sideways", tangential)):
        if std <= options.force_wanted:
            continue
        error = name == "normal" and std > options.force_limit
        limit = options.force_limit if error else options.force_wanted
        text = f"The {name} force is known to {std:.1%} only (limit {limit:.0%})."
        advice = (
            "Give more loads, larger ones, or ones that are known better."
            if name == "normal"
            else "Give a load with a known sideways force."
        )
        findings.append(Finding.graded(text, advice, error=error))
    return findings


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
