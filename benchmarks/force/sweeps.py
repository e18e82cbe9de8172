"""Errors over load, noise, wrong models, missing markers, large strain, rendered frames."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from cases import CONTACTS, LINEAR, SMOOTH, SOLVED_N, Contacting, ForceCase, load_neo_hookean_cases
from errors import ForceErrors, Limits, errors_of, noisy, oracle, outlined, reconstructed
from scipy.signal import savgol_filter

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import Load
from cmp_tactile_simulation.rendering.ink import PrintDefects
from cmp_tactile_simulation.scenes.description import (
    Hold,
    IndenterDescription,
    Phase,
    Press,
    Scene,
    Start,
    Touch,
)
from cmp_tactile_simulation.scenes.file import load_scene
from cmp_tactile_simulation.scenes.simulation import Simulation
from cmp_tactile_simulation.simulator import SimulatedFrame

# Multiples of the noise that the parameters state: 2 um in plane, 5 um in depth.
NOISE_SCALES, SMOOTHED_NOISE = (0.25, 0.5, 1.0, 2.0, 4.0), (1.0, 4.0)
MISSING_SHARES = (0.05, 0.10, 0.33)
# What sweeps other than those over cases and loads are measured on.
SOME_CASES = ("sphere", "edge", "ring", "shear")


@dataclass(frozen=True)
class Point:
    """Errors of one load under one condition of a sweep.

    limits: None where there is none.  NaN where not asked for: oracle, what it errs by, of the
    distribution and of Fz, N; outlined, error of the area that the true forces of the nodes give.
    """

    sweep: str
    condition: str
    case: ForceCase
    errors: ForceErrors
    limits: Limits | None = None
    oracle: tuple[float, float] = (float("nan"), float("nan"))
    outlined: float = float("nan")


def by_case(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """All cases at 10 N and 1 N."""
    for case in cases:
        if case.newton in (10.0, 1.0):
            errors = errors_of(model, case, frames)
            point = Point("case", case.material, case, errors, Limits.from_case(case))
            if case.material == LINEAR:
                best = oracle(model, case, frames)
                point = replace(point, oracle=best, outlined=outlined(model, case))
            yield point


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
            point = Point("load", f"{case.newton:g} N", case, errors, limits)
            if case.newton < 1:
                point = replace(point, oracle=oracle(model, case, frames))
            yield replace(point, outlined=outlined(model, case))


def by_noise(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """Some cases with other noise than the parameters state."""
    for case in _some(cases):
        for scale in NOISE_SCALES:
            errors = errors_of(model, case, frames, scale)
            yield Point("noise", f"noise x {scale:g}", case, errors)


def by_smoothing(model: ForceModel, cases: Sequence[ForceCase], frames: int) -> Iterator[Point]:
    """Some cases with displacements that a cubic surface through 5 x 5 markers has smoothed."""
    for case in _some(cases):
        for scale in SMOOTHED_NOISE:
            raw = np.stack(noisy(case, frames, scale))
            moved = savgol_filter(savgol_filter(raw, 5, 3, axis=1), 5, 3, axis=2)
            errors = ForceErrors.from_case(case, reconstructed(model, moved))
            off = [1e6 * np.std((found - case.displacement)[..., 0]) for found in (raw, moved)]
            name = f"noise x {scale:g}, along x {off[0]:.1f} -> {off[1]:.1f} um"
            yield Point("smoothing", name, case, errors)


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
            moved = [np.where(mask[..., None], np.nan, frame) for frame in noisy(case, frames)]
            errors = ForceErrors.from_case(case, reconstructed(model, moved, seen))
            yield Point("missing", name, case, errors)


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
                    yield Point("description", name, case, errors)


def wrong_models(sensor: SensorDescription) -> dict[str, SensorDescription]:
    """The sensor as it is, and as a user may wrongly describe it."""
    gel = sensor.elastomer
    layer = gel.shading_layer
    thicker = (*gel.size[:2], 1.05 * gel.size[2])
    stiff = replace(layer, young=1.1 * layer.young)
    changed = {
        "as it is": gel,
        "E 10 % too high": replace(gel, young=1.1 * gel.young, shading_layer=stiff),
        "nu 0.45 for 0.48": replace(gel, poisson=0.45),
        "nu 0.47 for 0.48": replace(gel, poisson=0.47),
        "gel 5 % too thick": replace(gel, size=thicker),
        "layer 0.4 mm for 0.3 mm": replace(gel, shading_layer=replace(layer, thickness=0.4e-3)),
        "layer twice as stiff": replace(gel, shading_layer=replace(layer, young=2 * layer.young)),
    }
    return {name: replace(sensor, elastomer=elastomer) for name, elastomer in changed.items()}


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
            yield Point("large press", name, case, ForceErrors.from_case(case, found))


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


REST_FRAMES, HELD_FRAMES = 8, 2
RENDERED_LOADS = (0.5, 1.0, 2.0, 5.0)
SHARE, NEWTON = 0.03, 0.02


RENDERED = {name: CONTACTS[name] for name in ("sphere", "edge", "ring", "off centre", "shear")}
RENDERED["ring"] = replace(CONTACTS["ring"], at=(0.0, 0.0))
FLAWED = "sphere, flawed print"
RENDERED[FLAWED] = CONTACTS["sphere"]
FLAWS = PrintDefects(missing_ink=20, splashes=10, ragged_edge=4e-5)


@dataclass(frozen=True)
class RenderedError:
    """Of one contact at one load, largest over its frames: errors, N and N m; std of Fz, N."""

    name: str
    newton: float
    fz: float
    ft: float
    torque: float
    fz_std: float

    @property
    def limit(self) -> float:
        """What the error of Fz must not exceed, N."""
        return SHARE * self.newton + NEWTON


def rendered_errors(sensor: SensorDescription) -> Iterator[RenderedError]:
    """Errors of every contact and load."""
    for name, contact in RENDERED.items():
        pipeline = Pipeline(sensor)
        simulation = Simulation(_scene(sensor, name, contact))
        rest, held = [], []
        for frame in simulation.frames():
            if frame.phase == "rest":
                rest.append(frame.image)
                if len(rest) == REST_FRAMES:
                    pipeline.set_reference(rest)
                continue
            held.append(_error(pipeline, frame))
            if len(held) == HELD_FRAMES:
                yield _largest(name, held)
                held = []


def _scene(sensor: SensorDescription, case: str, contact: Contacting) -> Scene:
    x, y = contact.tangential
    indenter: Any = contact.indenter
    phases = []
    for load in RENDERED_LOADS:
        name, goal = f"{load:g} N", Press(Load(load, (x * load, y * load)))
        # The load is reached in the first frame and held in those that follow.
        phases += [Phase(name, 1, goal), Phase(name, HELD_FRAMES - 1, Hold())]
    return replace(
        load_scene("contact_sphere"),
        name=f"force_{case}",
        sensor=sensor,
        defects=FLAWS if case == FLAWED else PrintDefects(),
        indenter=IndenterDescription(indenter.name, contact.friction, asdict(indenter)),
        start=Start(Touch(contact.at, 0.3e-3), contact.rotation_deg),
        motion=(Phase("rest", REST_FRAMES, Hold()), *phases),
    )


def _error(pipeline: Pipeline, frame: SimulatedFrame) -> tuple[float, ...]:
    found = pipeline.process(frame.image).force
    off = found.wrench - frame.force.wrench
    return (
        float(-frame.force.wrench[2]),
        float(abs(off[2])),
        float(np.linalg.norm(off[:2])),
        float(np.linalg.norm(off[3:])),
        float(found.random_std[2]),
    )


def _largest(name: str, held: list[tuple[float, ...]]) -> RenderedError:
    return RenderedError(name, *(float(value) for value in np.max(held, axis=0)))
