"""What speaks against a fitted material, in words, and the values before and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.compliance import ComplianceFamily, MaterialOptions
from cmp_tactile_processing.calibration.material.fit import MaterialFit
from cmp_tactile_processing.calibration.material.loads import LoadSample, strain_corrected
from cmp_tactile_processing.calibration.outcome import Estimate, Finding, Severity, provenance
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
