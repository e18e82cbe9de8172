"""Calibration of the gel's material: Young's modulus from loads that are known.

The force that the sensor shows goes with the modulus, also under large strain, where strain goes
with force over modulus.  So the loads are shown once, and the rest is linear: a factor, and for a
reference sensor the offset of its zero.  Poisson's ratio, thickness and shading layer stay as the
description has them; what that leaves open is in the error bar of every force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.calibration.material.loads import (
    LoadResult,
    LoadSample,
    MaterialOutcome,
    check_samples,
    material_verdict,
    sample_name,
)
from cmp_tactile_processing.calibration.outcome import Estimate, finding, provenance
from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.errors import CalibrationError, Finding
from cmp_tactile_processing.force.contact_regions import material_covariance
from cmp_tactile_processing.force.model import LINEAR_STD_PER_DEPTH_RATIO, ForceModel
from cmp_tactile_processing.measured import ForceField, Status
from cmp_tactile_processing.processes import OnProgress, no_progress
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord

Array = NDArray[np.float64]

METHODS = ("weights", "force_sensor")
# Standard deviations: of the described Poisson's ratio unless one is given; of the described
# modulus, relative; of a reference sensor's zero, N; of the model's force, relative to it.
POISSON_STD, YOUNG_STD, OFFSET_STD, MODEL_STD = 0.015, 0.55, 0.2, 0.005
# A load is left out where it is fewer standard deviations of its noise, or more from the fit.
LEAST_SIGNAL, OUTLIER = 5.0, 5.0
# Of the loads, this share may be wrong before nobody knows which ones are right.
MOST_WRONG = 1 / 3
# Relative standard deviation of the force in a good result, and in one that can be used.
WANTED_STD, LARGEST_STD = 0.03, 0.2
# Error of a linear model under large strain that is worth a word.
STRAIN_ERROR = 0.03
# Sideways force below this share of the normal force says nothing of sideways forces.
LEAST_SIDEWAYS = 0.1
# Least correlation between forces of the sensor and of the reference along the same axes.
MIN_AXIS_CORRELATION = 0.8
# A component of a load that is small beside it is modelled as well as this share of the load.
CROSS_TALK = 0.2
# How the response to a patch of 3 mm changes from Poisson's ratio 0.48 to 0.46, 6 % of it, comes
# out of this mesh to 0.014 % of the response.
COARSE = MeshDensity(across=12, rim=2, depth=3)
LARGEST_POISSON = 0.4995
# What a reference force sensor may give in place of newtons, N each; and how far, as a ratio, the
# factor of the modulus may be from the unit: a described modulus is known to YOUNG_STD.
FORCE_UNITS_N = {"pounds": 4.44822, "kilograms": 9.80665, "grams": 9.80665e-3, "millinewtons": 1e-3}
MAX_UNIT_RATIO = 1.3
# The deviations depend a little on the factor itself.
ROUNDS = 3


def fit_material(  # noqa: PLR0913, PLR0917 - what is known, how well, who is informed, where it is kept
    sensor: SensorDescription,
    samples: Sequence[LoadSample],
    method: str,
    poisson_std: float = POISSON_STD,
    on_progress: OnProgress = no_progress,
    cache_dir: Path | None = None,
) -> MaterialOutcome:
    """Young's modulus of a sensor's gel from samples of known load.

    method: "weights", or "force_sensor" with a zero that may be off, which is then fitted too.
    poisson_std: of the described Poisson's ratio, for the error bars.  cache_dir: see ElasticModel.
    Samples are of a gel at rest under its load; creep is taken out before, see RelaxationFilter.
    What is wrong with loads or result is among the findings.
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
        on_progress("loading the elastic model", 0.0)
        model = ForceModel(plain, cache_dir)
        on_progress("loading the elastic model", 1.0)
        fields = [model.reconstruct_random(item.displacement, item.status) for item in samples]
        reasons = {k: reason for k, shown in enumerate(fields) if (reason := _why_unusable(shown))}
        calibration = _Calibration(sensor, samples, fields, method, reasons)
        wrong = calibration.what_forbids_a_fit()
        if wrong is not None:
            return calibration.nothing(wrong)
        linear = ForceModel(
            replace(plain, force=replace(plain.force, large_press="off")), cache_dir
        )
        pressure = np.mean([np.abs(fields[k].force[:, 2]) for k in calibration.used], axis=0)
        doubt = poisson_doubt(sensor, linear, pressure, poisson_std)
    return calibration.outcome(doubt, poisson_std)


def _why_unusable(shown: ForceField) -> str:
    if not np.isfinite(shown.wrench).all():
        return f"only {shown.valid_fraction:.0%} of the markers were seen"
    if not shown.contact.any():
        return "the sensor measures no contact"
    signal = float(np.max(np.abs(shown.wrench[:3]) / shown.wrench_std[:3]))
    return "" if signal >= LEAST_SIGNAL else "it is too small compared with the noise"


@dataclass(frozen=True)
class PoissonDoubt:
    """What a Poisson's ratio that is wrong by one standard deviation changes at most, relative.

    normal: of normal forces; Young's modulus makes up for it.  sideways: of sideways forces beside
    the normal ones; nothing makes up for that.
    """

    normal: float
    sideways: float


def poisson_doubt(
    sensor: SensorDescription, model: ForceModel, pressure: Array, std: float
) -> PoissonDoubt:
    """How far a Poisson's ratio that is wrong by std changes the forces of a contact.

    pressure: normal forces (nodes,) N of it.  Forces of that distribution, normal and sideways,
    move the markers of a gel with the other ratio, and the model reads them; it is one without
    large strain.
    """
    if not std > 0:
        return PoissonDoubt(0.0, 0.0)
    problem = replace(ElasticProblem.from_sensor(sensor), density=COARSE)
    forces = np.zeros((2, len(pressure), 3))
    forces[0, :, 2], forces[1, :, 0] = -pressure, pressure
    # The coarse mesh shows how the displacement changes, that of the model what changes.
    described = _displacements(problem, forces)
    status = np.full(described.shape[1:3], Status.MEASURED, dtype=np.uint8)
    moved = [model.elastic.displacement(force) for force in forces]
    before = [model.reconstruct(u, status).wrench for u in moved]
    normal = sideways = 0.0
    for poisson in (problem.poisson - std, min(problem.poisson + std, LARGEST_POISSON)):
        changed = _displacements(replace(problem, poisson=poisson), forces)
        change = (changed - described) / sensor.elastomer.young
        after = [model.reconstruct(u, status).wrench for u in moved + change]
        press, push = (float(a @ b / (b @ b)) - 1 for a, b in zip(after, before, strict=True))
        normal, sideways = max(normal, abs(press)), max(sideways, abs(push - press))
    return PoissonDoubt(normal, sideways)


def _displacements(problem: ElasticProblem, forces: Array) -> Array:
    """Displacements (2, rows, cols, 3) m Pa of the markers under forces (2, nodes, 3) N."""
    columns = forces.reshape(len(forces), -1).T
    moved = problem.expand(problem.solve(columns), of_nodes=False)
    shape = len(forces), problem.markers.rows, problem.markers.cols, 3
    return np.asarray(moved.T.reshape(shape), dtype=np.float64)


@dataclass(frozen=True)
class Readings:
    """Loads as the sensor shows them beside what they are, gel frame, N; all (n, 3).

    shown, shown_std: with the description's modulus, and what noise makes of them.  reference,
    reference_std: NaN where not known.
    """

    shown: Array
    shown_std: Array
    reference: Array
    reference_std: Array

    def noise(self, factor: float) -> Array:
        """Standard deviations (n, 3) of shown times factor less reference, of noise alone."""
        return np.asarray(np.hypot(factor * self.shown_std, self.reference_std))

    def std(self, factor: float, doubt: PoissonDoubt) -> Array:
        """The same with the errors of the model and of Poisson's ratio."""
        size = factor * np.abs(self.shown)
        least = CROSS_TALK * np.linalg.norm(size, axis=1, keepdims=True)
        model = MODEL_STD * np.hypot(size, least)
        sideways = doubt.sideways * size * (1.0, 1.0, 0.0)
        return np.asarray(np.sqrt(self.noise(factor) ** 2 + model**2 + sideways**2))

    def relative_spread(self, off: Array, factor: float, axes: slice, fitted: int) -> float:
        """Relative error of the forces along some axes beyond the noise, 0 without any.

        off (n, 3) N: residuals.  fitted: of the loads, used up by what was fitted to them.
        """
        size = np.linalg.norm(np.nan_to_num(self.reference), axis=1)
        force = np.linalg.norm(self.reference[:, axes], axis=1)
        large = force > LEAST_SIDEWAYS * size
        count = int(large.sum()) - fitted
        if count <= 0:
            return 0.0
        squares = off[large, axes] ** 2 - self.noise(factor)[large, axes] ** 2
        beyond = max(0.0, float(squares.sum())) / count
        return float(np.sqrt(beyond / np.mean(force[large] ** 2)))


@dataclass(frozen=True)
class ScaleFit:
    """factor: of Young's modulus, std relative, of what differs between loads and of the model.

    offset, offset_std (3,) N: of the reference, NaN where it has none.  misfits (n,): root mean
    square of shown minus reference in standard deviations.  normal_std, sideways_std: of forces
    with the new modulus, relative, with what Poisson's ratio leaves open.
    """

    factor: float
    std: float
    offset: Array
    offset_std: Array
    misfits: Array
    normal_std: float
    sideways_std: float


def fit_scale(readings: Readings, doubt: PoissonDoubt, *, has_offset: bool) -> ScaleFit:
    """The factor that makes the loads right on the whole."""
    known = np.isfinite(readings.reference)
    prior_std = np.array([YOUNG_STD] + 3 * [OFFSET_STD * has_offset])
    free = prior_std > 0
    prior = np.diag(prior_std[free] ** -2)
    columns = np.zeros((*known.shape, 4))
    columns[..., 0], columns[..., 1:] = readings.shown, np.eye(3)
    x = np.array([1.0, 0.0, 0.0, 0.0])
    for _ in range(ROUNDS):
        weight = 1 / readings.std(float(x[0]), doubt)[known]
        A = (columns[known] * weight[:, None])[:, free]
        covariance = np.linalg.inv(A.T @ A + prior)
        x[free] = covariance @ (A.T @ (weight * readings.reference[known]) + prior[:, 0])
    factor = float(x[0])
    off = np.where(known, columns @ x - readings.reference, np.nan)
    variance = np.full(4, np.nan)
    variance[free] = np.diag(covariance)
    # What the model errs by in all loads alike is not averaged out.
    common = MODEL_STD * np.sqrt(1 - 1 / len(known))
    # One of the normal forces is as good as used up: the modulus makes it right.
    normal_spread = readings.relative_spread(off, factor, slice(2, 3), fitted=1)
    sideways_spread = readings.relative_spread(off, factor, slice(0, 2), fitted=0)
    std = float(np.sqrt(variance[0] / factor**2 + common**2 + normal_spread**2))
    return ScaleFit(
        factor=factor,
        std=std,
        offset=np.where(free[1:], x[1:], np.nan),
        offset_std=np.sqrt(variance[1:]),
        misfits=np.sqrt(np.nanmean((off / readings.std(factor, doubt)) ** 2, axis=1)),
        normal_std=float(np.hypot(std, doubt.normal)),
        sideways_std=float(np.sqrt(std**2 + doubt.sideways**2 + sideways_spread**2)),
    )


@dataclass
class _Calibration:
    """The loads on their way to an outcome; `reasons` says which ones were left out, and why."""

    sensor: SensorDescription
    samples: Sequence[LoadSample]
    fields: Sequence[ForceField]
    method: str
    reasons: dict[int, str]

    @property
    def used(self) -> list[int]:
        """The loads that were not left out."""
        return [k for k in range(len(self.samples)) if k not in self.reasons]

    def what_forbids_a_fit(self) -> Finding | None:
        """An error for loads that were not seen, or are in another frame."""
        if self.used:
            readings = self._readings(self.used)
            return axis_finding(readings.shown, readings.reference)
        seen = "; ".join(f"{self._name(k)}: {reason}" for k, reason in self.reasons.items())
        return finding("no load", error=True, seen=seen)

    def nothing(self, wrong: Finding) -> MaterialOutcome:
        """The outcome where nothing was fitted: the description as it is."""
        unknown = np.full(3, np.nan)
        verdict = f"Not usable. {wrong.text}"
        return MaterialOutcome(
            self.method, self.sensor, (), self._results(), unknown, unknown, (wrong,), verdict
        )

    def outcome(self, doubt: PoissonDoubt, poisson_std: float) -> MaterialOutcome:
        """Fit the modulus and say what is wrong."""
        fit, contradiction = self._robust_fit(doubt)
        estimates = material_estimates(self.sensor, fit, poisson_std)
        record = MaterialRecord(
            method=self.method,
            samples=len(self.used),
            normal_std=fit.normal_std,
            tangential_std=fit.sideways_std,
            young_std=fit.normal_std if estimates[0].determined else float("nan"),
            **provenance(estimates),
        )
        gel = self.sensor.elastomer
        layer = replace(gel.shading_layer, young=fit.factor * gel.shading_layer.young)
        gel = replace(gel, young=fit.factor * gel.young, shading_layer=layer, calibration=record)
        outcome = MaterialOutcome(
            method=self.method,
            sensor=replace(self.sensor, elastomer=gel),
            estimates=estimates,
            loads=self._results(fit.factor, (fit.normal_std, fit.sideways_std)),
            offset=fit.offset,
            offset_std=fit.offset_std,
            findings=(
                *contradiction,
                *self._left_out_findings(),
                *load_findings(self.sensor, [self.samples[k] for k in self.used]),
                *certainty_findings(fit),
                *(unit_findings(self.sensor, fit.factor) if fit.factor > 0 else []),
            ),
        )
        return replace(outcome, verdict=material_verdict(outcome))

    def _name(self, index: int) -> str:
        return sample_name(self.samples, index)

    def _readings(self, used: Sequence[int]) -> Readings:
        return Readings(
            shown=np.array([self.fields[k].wrench[:3] for k in used]),
            shown_std=np.array([self.fields[k].wrench_std[:3] for k in used]),
            reference=np.array([self.samples[k].force for k in used], dtype=np.float64),
            reference_std=np.array([self.samples[k].std for k in used], dtype=np.float64),
        )

    def _robust_fit(self, doubt: PoissonDoubt) -> tuple[ScaleFit, list[Finding]]:
        """Fit, leaving out loads that contradict the others."""
        wrong, has_offset = 0, self.method == "force_sensor"
        while True:
            used = self.used
            fit = fit_scale(self._readings(used), doubt, has_offset=has_offset)
            worst = int(np.argmax(fit.misfits))
            misfit = float(fit.misfits[worst])
            if misfit <= OUTLIER:
                return fit, []
            wrong += 1
            if len(used) < 3 or wrong > MOST_WRONG * len(self.samples):
                name = self._name(used[worst])
                values = {"load": name, "misfit": misfit, "limit": OUTLIER}
                return fit, [finding("contradiction", error=True, **values)]
            reason = f"it is {misfit:.0f} standard deviations from the fit of the others"
            self.reasons[used[worst]] = reason

    def _left_out_findings(self) -> list[Finding]:
        return [
            finding("load left out", error=False, load=f"L{self._name(k)[1:]}", why=why)
            for k, why in self.reasons.items()
        ]

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
                    reason=self.reasons.get(k, ""),
                )
            )
        return tuple(results)


def material_estimates(
    sensor: SensorDescription, fit: ScaleFit, poisson_std: float
) -> tuple[Estimate, ...]:
    """Estimates of both moduli, then of what was kept.

    The shading layer's modulus keeps its ratio to the gel's, which no load determines.
    """
    gel, std = sensor.elastomer, fit.normal_std
    young, layer = (fit.factor * value for value in (gel.young, gel.shading_layer.young))
    thickness = gel.shading_layer.thickness
    kept = (
        ("poisson", "", gel.poisson, poisson_std),
        ("size[2]", "m", gel.size[2], 0.0),
        ("shading_layer.thickness", "m", thickness, 0.0),
    )
    name = "elastomer.shading_layer.young"
    return (
        Estimate("elastomer.young", "Pa", gel.young, young, std * young, std <= YOUNG_STD / 2),
        Estimate(name, "Pa", gel.shading_layer.young, layer, std * layer, determined=False),
        *(
            Estimate(f"elastomer.{key}", unit, value, value, deviation, determined=False)
            for key, unit, value, deviation in kept
        ),
    )


def axis_finding(shown: Array, given: Array) -> Finding | None:
    """Does the reference point where the sensor does?  shown, given (n, 3) N; given may be NaN."""
    scale = float(np.nanmax(np.abs(given)))
    if _likeness(shown[:, 2:], given[:, 2:], scale) < -MIN_AXIS_CORRELATION:
        return finding("wrong sign", error=True)
    if _likeness(shown[:, :2], given[:, :2], scale) < MIN_AXIS_CORRELATION:
        return finding("turned", error=True)
    return None


def _likeness(a: Array, b: Array, scale: float) -> float:
    """Correlation of forces about 0, 1 where they are too small to say."""
    known = np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    return float((a * b).sum()) / power if power > (LEAST_SIDEWAYS * scale) ** 2 else 1.0


def load_findings(sensor: SensorDescription, samples: Sequence[LoadSample]) -> list[Finding]:
    """Do the loads show what they should, and are they small enough for a linear gel?"""
    findings = []
    forces = np.array([np.nan_to_num(sample.force) for sample in samples])
    if len(samples) == 1:
        findings.append(finding("one load", error=False))
    sideways = np.linalg.norm(forces[:, :2], axis=1) > LEAST_SIDEWAYS * np.abs(forces[:, 2])
    if not sideways.any():
        findings.append(finding("presses alone", error=False))
    choice, neo_hookean = sensor.force.large_press, sensor.elastomer.model == "neo_hookean"
    depth = max(float(np.nanmax(np.abs(sample.displacement[..., 2]))) for sample in samples)
    share = depth / sensor.elastomer.size[2]
    corrected = choice == "on" or (choice == "auto" and neo_hookean)
    error = LINEAR_STD_PER_DEPTH_RATIO * share
    if not corrected and error > STRAIN_ERROR:
        values = {"depth": depth * 1e3, "share": share, "limit": STRAIN_ERROR}
        findings.append(finding("large press", error=False, linear_error=error, **values))
    return findings


def unit_findings(sensor: SensorDescription, factor: float) -> list[Finding]:
    """Does the factor of the modulus look like another unit of the loads?"""
    for unit, newtons in FORCE_UNITS_N.items():
        if abs(math.log(factor * newtons)) > math.log(MAX_UNIT_RATIO):
            continue
        values = {"factor": factor, "unit": unit, "unit_factor": 1 / newtons}
        young = factor * sensor.elastomer.young
        return [finding("other unit", error=True, young=young, **values)]
    return []


def certainty_findings(fit: ScaleFit) -> list[Finding]:
    """Is the force known well enough with this material?"""
    findings = []
    if fit.normal_std > WANTED_STD:
        error = fit.normal_std > LARGEST_STD
        values = {"std": fit.normal_std, "limit": LARGEST_STD if error else WANTED_STD}
        findings.append(finding("normal force uncertain", error=error, **values))
    if fit.sideways_std > WANTED_STD:
        values = {"std": fit.sideways_std, "limit": WANTED_STD}
        findings.append(finding("sideways force uncertain", error=False, **values))
    return findings
