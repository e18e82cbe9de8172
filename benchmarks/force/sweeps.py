"""Errors over load, noise, wrong models, missing markers, large strain, rendered frames; times."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from cases import LINEAR, SMOOTH, SOLVED_N, ForceCase, load_neo_hookean_cases
from errors import NOISE_M, ForceErrors, Limits, errors_of, noisy, oracle_l2, reconstructed
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from cmp_tactile_processing.errors import CmpTactileError
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.traction_spectrum import (
    TractionSpectrum,
    nodal_force_matrix,
    smoothness,
)
from cmp_tactile_processing.measured import Status
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.contact.laws import Load
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
from cmp_tactile_simulation.scenes.simulation import SimulatedFrame, Simulation

# Multiples of the noise that the parameters state: 2 um in plane, 5 um in depth.
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
    """Some cases with other noise than the parameters state."""
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


REPEATS = 300


@dataclass(frozen=True)
class Speed:
    """Shortest times of many frames, ms; s and MB of the model.  NaN: not available.

    first_ms: of the first pass by itself; one_pass_ms: of a frame with that pass alone, contacts
    and error bars included.
    """

    first_ms: float
    one_pass_ms: float
    rest_ms: float
    two_pass_ms: float
    corrected_ms: float
    build_s: float
    load_s: float
    cache_mb: float


def measure_speed(sensor: SensorDescription, cases: Sequence[ForceCase]) -> Speed:
    """Times of the sphere at 5 N; the corrected model's of a frame much like the one before."""
    case = next(case for case in cases if case.name == "sphere" and case.newton == 5.0)
    moved = noisy(case, 1)[0]
    noise = replace(case, displacement=np.zeros_like(moved))
    with threadpool_limits(1), tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = process_time()
        both = ForceModel(sensor, folder)
        build = process_time() - start
        size = sum(path.stat().st_size for path in folder.rglob("*")) / 1e6
        load = _shortest(lambda: ForceModel(sensor, folder), 5)
        one = replace(sensor, force=replace(sensor.force, two_pass=False))
        single = ForceModel(one, folder)
        return Speed(
            first_ms=1e3 * _first_pass_time(both, sensor, moved),
            one_pass_ms=1e3 * _frame_time(single, moved),
            rest_ms=1e3 * _frame_time(both, noisy(noise, 1)[0]),
            two_pass_ms=1e3 * _frame_time(both, moved),
            corrected_ms=1e3 * _corrected_time(sensor, moved),
            build_s=build,
            load_s=load,
            cache_mb=size,
        )


def _first_pass_time(
    model: ForceModel, sensor: SensorDescription, moved: NDArray[np.float64]
) -> float:
    """What the force model does first with every frame, made of the same parts."""
    nodes, markers = model.elastic.nodes, model.elastic.markers
    precision = smoothness(nodes, sensor.force.smoothing_length)
    noise = np.tile(NOISE_M, markers.rows * markers.cols)
    response = model.elastic.compliance / noise[:, None]
    spectrum = TractionSpectrum(markers, nodes, response, precision, nodal_force_matrix(nodes))
    data, known = moved.ravel() / noise, np.ones(moved.size, dtype=bool)
    return _shortest(lambda: spectrum.solve(data, known), REPEATS)


def _corrected_time(sensor: SensorDescription, moved: NDArray[np.float64]) -> float:
    model = large_press_models(sensor)["corrected"]
    seen = np.full(moved.shape[:2], Status.MEASURED, dtype=np.uint8)
    # A third of the load: about as deep as the correction is meant for.
    if not model.reconstruct(moved / 3, seen).corrected:
        return float("nan")
    return _frame_time(model, moved / 3, 20)


def _frame_time(model: ForceModel, moved: NDArray[np.float64], repeats: int = REPEATS) -> float:
    seen = np.full(moved.shape[:2], Status.MEASURED, dtype=np.uint8)
    return _shortest(lambda: model.reconstruct(moved, seen), repeats)


def _shortest(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = process_time()
        work()
        times.append(process_time() - start)
    return min(times)


REST_FRAMES, HELD_FRAMES = 8, 2
RENDERED_LOADS = (0.5, 1.0, 2.0, 5.0)
SHARE, NEWTON = 0.03, 0.02


@dataclass(frozen=True)
class RenderedContact:
    """An indenter, where it is let down, m, and its tangential force as a share of the normal."""

    name: str
    type: str
    values: Mapping[str, Any]
    at: tuple[float, float] = (0.0, 0.0)
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)


RENDERED = (
    RenderedContact("sphere", "sphere", {"radius": 8e-3}, (0.4e-3, -0.3e-3)),
    RenderedContact(
        "edge", "cylinder", {"radius": 2e-3, "length": 8e-3, "edge_radius": 1e-3},
        rotation_deg=(0.0, 0.0, 20.0),
    ),
    RenderedContact("ring", "ring", {"radius": 3.2e-3, "tube_radius": 1e-3}),
    RenderedContact(
        "off centre", "sphere", {"radius": 6e-3}, (2e-3, -1.4e-3), tangential=(0.1, -0.1)
    ),
    RenderedContact("shear", "sphere", {"radius": 8e-3}, tangential=(0.3, 0.1)),
)  # fmt: skip


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


def rendered_errors(sensor: SensorDescription, quick: bool = False) -> Iterator[RenderedError]:
    """Errors of every contact and load."""
    for contact in RENDERED[: 1 if quick else None]:
        pipeline = Pipeline(sensor)
        simulation = Simulation(_scene(sensor, contact))
        rest, held = [], []
        for frame in simulation.frames():
            if frame.phase == "rest":
                rest.append(frame.image)
                if len(rest) == REST_FRAMES:
                    pipeline.set_reference(rest)
                continue
            held.append(_error(pipeline, frame))
            if len(held) == HELD_FRAMES:
                yield _largest(contact.name, held)
                held = []


def _scene(sensor: SensorDescription, contact: RenderedContact) -> Scene:
    x, y = contact.tangential
    steps = tuple(
        Phase(f"{load:g} N", HELD_FRAMES, Press(Load(load, (x * load, y * load))))
        for load in RENDERED_LOADS
    )
    phases = []
    for step in steps:
        # The load is reached in the first frame and held in those that follow.
        phases += [replace(step, frames=1), Phase(step.name, HELD_FRAMES - 1, Hold())]
    return replace(
        load_scene("contact_sphere"),
        name=f"force_{contact.name}",
        sensor=sensor,
        indenter=IndenterDescription(contact.type, 0.6, contact.values),
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
        float(found.wrench_std[2]),
    )


def _largest(name: str, held: list[tuple[float, ...]]) -> RenderedError:
    return RenderedError(name, *(float(value) for value in np.max(held, axis=0)))
