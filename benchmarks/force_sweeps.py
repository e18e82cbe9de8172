"""Errors of force over load, noise, wrong models, missing markers and large strain."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from force_cases import LINEAR, SMOOTH, SOLVED_N, ForceCase, load_neo_hookean_cases
from force_errors import ForceErrors, Limits, errors_of, noisy, oracle_l2, reconstructed
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured.grid import Status
from cmp_tactile_processing.sensor.description import SensorDescription

# Multiples of the noise that the parameters tell: 2 um in plane, 5 um in depth.
NOISE_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)
MISSING_SHARES = (0.05, 0.10, 0.33)
# What sweeps other than those over cases and loads are measured on.
SOME_CASES = ("sphere", "edge", "ring", "shear")


@dataclass(frozen=True)
class Point:
    """Errors of one load under one condition of a sweep.

    limits: None where there is none.  oracle: least distribution error, NaN where not asked for.
    """

    sweep: str
    condition: str
    level: float
    case: ForceCase
    errors: ForceErrors
    limits: Limits | None = None
    oracle: float = float("nan")


def by_case(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """All cases at 10 N and 1 N."""
    for case in cases:
        if case.newton in (10.0, 1.0):
            errors = errors_of(model, case, frames)
            best = oracle_l2(model, case) if case.material == LINEAR else float("nan")
            yield Point(
                "case", case.material, case.newton, case, errors, Limits.from_case(case), best
            )


def by_load(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """Contacts at every load; those above 10 N are the contact of 10 N on a gel that stays linear.

    Its surface then moves farther than the gel is thick, and a torque by where it has moved to
    means nothing.
    """
    for case in cases:
        if case.material == LINEAR:
            limits = replace(Limits.from_case(case), l2=float("nan"))
            if case.newton > SOLVED_N[-1]:
                limits = replace(limits, torque=float("nan"))
            errors = errors_of(model, case, frames)
            yield Point("load", f"{case.newton:g} N", case.newton, case, errors, limits)


def by_noise(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """Some cases with other noise than the parameters tell."""
    for case in _some(cases):
        for scale in NOISE_SCALES:
            errors = errors_of(model, case, frames, scale)
            yield Point("noise", f"noise x {scale:g}", scale, case, errors)


def by_missing(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """Some cases without some of the markers: at random, or all of a square under the load."""
    markers = model.elastic.markers
    random = np.random.default_rng(5)
    masks = {
        f"{100 * share:g} % at random": random.random((markers.rows, markers.cols)) < share
        for share in MISSING_SHARES
    }
    hole = np.zeros((markers.rows, markers.cols), dtype=bool)
    hole[markers.rows // 2 - 2 : markers.rows // 2 + 2, markers.cols // 2 - 2 :][:, :4] = True
    masks["4 x 4 in the middle"] = hole
    for case in _some(cases):
        for name, mask in masks.items():
            seen = np.where(mask, Status.MISSING, Status.MEASURED).astype(np.uint8)
            moved = [_without(frame, mask) for frame in noisy(case, frames)]
            errors = ForceErrors.from_case(case, reconstructed(model, moved, seen))
            yield Point("missing", name, float(mask.mean()), case, errors)


def by_description(
    sensor: SensorDescription, cases: Sequence[ForceCase], frames: int
) -> Iterator[Point]:
    """Some cases with a model of another gel than the one that was pressed."""
    with tempfile.TemporaryDirectory() as folder:
        for name, wrong in wrong_models(sensor).items():
            model = ForceModel(wrong, Path(folder))
            for case in _some(cases):
                if case.newton == 10.0:
                    errors = errors_of(model, case, frames)
                    yield Point("description", name, float("nan"), case, errors)


def wrong_models(sensor: SensorDescription) -> dict[str, SensorDescription]:
    """The sensor as it is, and as a user may wrongly describe it."""
    gel = sensor.elastomer
    layer = gel.shading_layer
    thicker = (*gel.size[:2], 1.05 * gel.size[2])
    changed = {
        "as it is": gel,
        "E 10 % too high": replace(gel, young=1.1 * gel.young),
        "nu 0.45 for 0.48": replace(gel, poisson=0.45),
        "nu 0.47 for 0.48": replace(gel, poisson=0.47),
        "gel 5 % too thick": replace(gel, size=thicker),
        "layer 0.4 mm for 0.3 mm": replace(gel, shading_layer=replace(layer, thickness=0.4e-3)),
        "layer twice as stiff": replace(gel, shading_layer=replace(layer, young=2 * layer.young)),
    }
    found = {name: replace(sensor, elastomer=elastomer) for name, elastomer in changed.items()}
    stiff = found["E 10 % too high"]
    skin = replace(stiff.elastomer.shading_layer, young=1.1 * layer.young)
    elastomer = replace(stiff.elastomer, shading_layer=skin)
    return {**found, "E 10 % too high": replace(stiff, elastomer=elastomer)}


def by_large_press(sensor: SensorDescription, frames: int) -> Iterator[Point]:
    """A neo-Hookean gel, pressed ever deeper: the linear model against the corrected one."""
    cases = load_neo_hookean_cases(sensor)
    for name, model in large_press_models(sensor).items():
        for case in cases:
            try:
                found = reconstructed(model, noisy(case, frames))
            except CmpTactileError:
                continue
            if name == "corrected" and not any(field.corrected for field in found):
                continue
            yield Point("large press", name, case.depth, case, ForceErrors.from_case(case, found))


def large_press_models(sensor: SensorDescription) -> dict[str, ForceModel]:
    """The linear model and the corrected one of the same gel."""
    gel = replace(sensor, elastomer=replace(sensor.elastomer, model="neo_hookean"))
    return {
        name: ForceModel(replace(gel, force=replace(sensor.force, large_press=choice)))
        for name, choice in (("linear", "off"), ("corrected", "on"))
    }


def _some(cases: Sequence[ForceCase]) -> Iterator[ForceCase]:
    for case in cases:
        if case.material != SMOOTH and case.name in SOME_CASES and case.newton in (1.0, 10.0):
            yield case


def _without(moved: NDArray[np.float64], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    kept = moved.copy()
    kept[mask] = np.nan
    return kept
