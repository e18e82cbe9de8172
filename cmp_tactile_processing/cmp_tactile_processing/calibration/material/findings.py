"""What speaks against a material that was found from known loads, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.material.loads import LoadSample
from cmp_tactile_processing.calibration.material.options import MaterialOptions
from cmp_tactile_processing.calibration.material.scale import LEAST_SIDEWAYS
from cmp_tactile_processing.calibration.outcome import Finding, Severity
from cmp_tactile_processing.force.model import LINEAR_DOUBT
from cmp_tactile_processing.sensor.description import SensorDescription

# A correlation as strong as this is that of the same axis.
ALIKE = 0.8
# A reference that is turned by more than this about z, rad, was not turned into the gel frame.
LARGEST_TURN = np.radians(20)
# By so much must the mirrored reference resemble the sensor's forces more.
CLEARLY_MIRRORED = 0.03
# Loads that differ by less than this factor say as much as one.
LEAST_RANGE = 1.5
# Standard deviations beyond which an offset is there.
CLEAR = 3.0
MOST_LISTED = 6


def axis_findings(shown: NDArray[np.float64], given: NDArray[np.float64]) -> list[Finding]:
    """Does the reference point where the sensor does?  shown, given (n, 3) N; given may be NaN."""
    advice = (
        "Give forces on the gel, in the gel frame: z points out of the gel, so a press is "
        "negative. Rotate the reference into this frame (--wrench-rotation, --wrench-reaction)."
    )
    scale = np.abs(given[np.isfinite(given)]).max()
    if _likeness(shown[:, 2], given[:, 2], scale) < -ALIKE:
        text = (
            f"The reference has the wrong sign: the sensor measures {_listed(shown[:, 2])} N "
            f"along z, the reference {_listed(given[:, 2])} N."
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
        "relative to the gel frame, so its sideways forces have another direction than the "
        "sensor's."
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
    advice = "Check this load, and correct or replace it: it has no effect on the result."
    return [
        Finding(Severity.WARNING, f"{name[0].upper()}{name[1:]} was left out: {reason}.", advice)
        for name, reason in reasons.items()
    ]


def misfit_finding(worst: str, misfit: float, limit: float) -> Finding:
    """The loads contradict one another."""
    text = (
        f"The loads contradict one another: no material fits all of them; {worst} is {misfit:.1f} "
        f"standard deviations off (limit {limit:g})."
    )
    advice = (
        "Check the values of the loads, and that the gel was at rest under each. Use loads that "
        "are certain, or larger standard deviations."
    )
    return Finding(Severity.ERROR, text, advice)


def offset_finding(offset: NDArray[np.float64], std: NDArray[np.float64]) -> list[Finding]:
    """Does the reference sensor read something where nothing is?"""
    clear = np.abs(offset) > CLEAR * std
    if not clear.any():
        return []
    values = ", ".join(
        f"{offset[k]:+.3g} N along {axis}" for k, axis in enumerate("xyz") if clear[k]
    )
    text = f"The reference sensor has an offset of {values}. It was subtracted."
    return [
        Finding(Severity.WARNING, text, "Zero the reference sensor before you apply the loads.")
    ]


def _strain_corrected(sensor: SensorDescription) -> bool:
    """Whether ForceModel takes out what large strain does to this gel."""
    choice = sensor.force.large_press
    return choice == "on" or (choice == "auto" and sensor.elastomer.model == "neo_hookean")


def range_findings(
    sensor: SensorDescription, samples: Sequence[LoadSample], options: MaterialOptions
) -> list[Finding]:
    """Were loads so large that a linear gel is a poor model, and is used as one?"""
    if _strain_corrected(sensor):
        return []
    depth = max(float(np.nanmax(np.abs(sample.displacement[..., 2]))) for sample in samples)
    share = depth / sensor.elastomer.size[2]
    error = LINEAR_DOUBT * share
    if error <= options.strain_error:
        return []
    text = (
        f"Loads press the gel by up to {depth * 1e3:.2g} mm, {share:.1%} of its thickness, and "
        "the gel is modelled as linear. If it is rubber-like, forces are wrong by up to "
        f"{error:.0%} (limit {options.strain_error:.0%})."
    )
    deep = options.strain_error / LINEAR_DOUBT * sensor.elastomer.size[2]
    return [Finding(Severity.WARNING, text, _strain_advice(sensor, deep))]


def _strain_advice(sensor: SensorDescription, depth: float) -> str:
    less = f"or use loads that press by less than {depth * 1e3:.2g} mm."
    if sensor.elastomer.model == "neo_hookean":
        return f"Do not set force.large_press to off, {less}"
    return f"For a silicone gel set elastomer.model to neo_hookean, which corrects for this, {less}"


def variety_findings(samples: Sequence[LoadSample], method: str) -> list[Finding]:
    """Do the loads differ enough to show what they should?"""
    findings = []
    forces = np.array([np.nan_to_num(sample.force) for sample in samples])
    sizes = np.linalg.norm(forces, axis=1)
    advice = "Give three loads or more over the range in which you use the sensor."
    if len(samples) == 1:
        text = "There is only one load, so it cannot be checked."
        findings.append(Finding(Severity.WARNING, text, advice))
    elif sizes.max() < LEAST_RANGE * sizes.min():
        text = f"All loads are similar, {sizes.min():.3g} to {sizes.max():.3g} N: "
        text += (
            "an offset of the reference cannot be separated from the modulus."
            if method == "force_sensor"
            else "an error that grows with the load cannot be detected."
        )
        findings.append(Finding(Severity.WARNING, text, advice))
    sideways = np.linalg.norm(forces[:, :2], axis=1) > LEAST_SIDEWAYS * np.abs(forces[:, 2])
    if not sideways.any():
        text = (
            "All loads are presses, so the accuracy of sideways forces depends on Poisson's ratio."
        )
        advice = "Add a sideways load: a weight on the tilted sensor, or a sideways pull."
        findings.append(Finding(Severity.WARNING, text, advice))
    return findings


def certainty_findings(normal: float, tangential: float, options: MaterialOptions) -> list[Finding]:
    """Is the force known well enough with this material?"""
    findings = []
    for name, std in (("normal", normal), ("sideways", tangential)):
        if std <= options.force_wanted:
            continue
        error = name == "normal" and std > options.force_limit
        limit = options.force_limit if error else options.force_wanted
        text = f"The {name} force is known only to {std:.1%} (limit {limit:.0%})."
        advice = (
            "Add loads, or give larger or more certain ones, on a foot or ball that is narrower "
            "than the gel is thick; or set --poisson-std."
            if name == "normal"
            else "Add a load with a known sideways force. If the sensor measures it wrongly, "
            "correct elastomer.poisson and elastomer.size."
        )
        findings.append(Finding.graded(text, advice, error=error))
    return findings
