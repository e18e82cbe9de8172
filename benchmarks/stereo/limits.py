"""What triangulation must reach, each limit with what was measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from chain import (
    UNCHANGED,
    Chain,
    Points,
    Shot,
    corner_errors,
    displacement_errors,
    gel_calibrations,
    joined,
    line_errors,
    measure_speed,
    sample,
    simulated,
    with_optics,
    without_distortion,
    without_layers,
)

from cmp_tactile_processing.measured import Markers3D, Status
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.stereo.rig import StereoRig
from cmp_tactile_simulation.hard_frames.library import sample_names
from cmp_tactile_simulation.rendering.camera import CameraSettings


@dataclass(frozen=True)
class Row:
    """A line of a table: what, its limit ("-" for none), what was measured, whether it is met."""

    part: str
    name: str
    limit: str
    measured: str
    met: bool | None


class LimitParts:
    """A run of several parts: the method `_NAME` yields the lines of part NAME."""

    PARTS: ClassVar[tuple[str, ...]] = ()

    def rows(self, parts: Sequence[str] = ()) -> Iterable[Row]:
        """The lines of these parts, one after the other; all where none is named."""
        for part in self.PARTS:
            if not parts or part in parts:
                yield from getattr(self, f"_{part}")()


STILLS = ("rest", "press", "slide", "twist", "bumps")
KINDS = ("rest", "press", "slide")
RIGS = ("sample_rig", "prototype")
# Limits, um.  The paper states less than 20 um for all markers of its simulated objects.
CLEAN_UM, HARD_UM, MODEL_UM, PAPER_UM = 3.0, 8.0, 5.0, 20.0
HARD = {
    "blur 2": replace(UNCHANGED, blur=2.0),
    "noise 7": replace(UNCHANGED, read_noise=7.0),
}
# The right view far out of focus, the left one in focus.
UNEQUAL = replace(UNCHANGED, defocus=6.0, focus_position=0.0, focus_direction=0.0, read_noise=4.0)
SWEEPS: dict[str, tuple[str, tuple[float, ...], Callable[[float], CameraSettings]]] = {
    "blur": ("px", (0.0, 1.0, 2.0, 3.0, 4.0), lambda level: replace(UNCHANGED, blur=level)),
    "noise": (
        "grey levels",
        (0.0, 2.0, 4.0, 7.0, 12.0, 16.0),
        lambda level: replace(UNCHANGED, read_noise=level),
    ),
}
SPEED_MS = 1.0
GEL_SHARE, GEL_UM = 0.01, 5.0


@dataclass(frozen=True)
class SweepPoint:
    """Mean errors at one level of a sweep, um."""

    sweep: str
    unit: str
    level: float
    errors: dict[str, float]


@dataclass
class LimitRun(LimitParts):
    """Measures all.  samples: folder of sample frames, or None.  quick: fewer frames of each."""

    samples: Path | None
    quick: bool = False

    PARTS: ClassVar[tuple[str, ...]] = (
        "samples", "simulated", "refraction", "methods", "speed", "gel",
    )  # fmt: skip

    @cached_property
    def _plain(self) -> Chain:
        return Chain(load_sensor("sample_rig"))

    def _samples(self) -> Iterable[Row]:
        """Frames of an independent renderer."""
        if self.samples is None:
            return
        chain, folder = self._plain, self.samples
        stills = {name: sample(chain.sensor, folder, f"still/{name}") for name in STILLS}
        seen = {name: (chain.markers(shot), shot.truth) for name, shot in stills.items()}
        for name, pair in seen.items():
            yield _limited("samples", f"still {name}", corner_errors(*pair), CLEAN_UM)
        names = sample_names(folder, "grasp")[:: 10 if self.quick else 1]
        grasp = [sample(chain.sensor, folder, name) for name in names]
        errors = [corner_errors(chain.markers(shot), shot.truth) for shot in grasp]
        yield _limited("samples", f"grasp, {len(grasp)} frames", joined(errors), CLEAN_UM)
        worst = max(errors, key=lambda part: float(part.mean()))
        yield _limited("samples", "grasp, worst frame", worst, CLEAN_UM)
        for status in (Status.MEASURED, Status.PREDICTED):
            off = joined([line_errors(*pair, status) for pair in seen.values()])
            yield _informed("samples", f"stills: virtual markers, {status.name.lower()}", off)
        yield from self._hard_samples(chain, folder, stills)

    def _hard_samples(self, chain: Chain, folder: Path, stills: dict[str, Shot]) -> Iterable[Row]:
        worn = [sample(chain.sensor, folder, f"still/worn_{name}") for name in ("rest", "slide")]
        yield self._displacement("samples", "worn print: displacement, slide", chain, worn)
        for name, camera in HARD.items():
            shots = {
                still: shot.seen_by(camera, seed)
                for seed, (still, shot) in enumerate(stills.items())
            }
            for still in STILLS[1:]:
                pair = [shots["rest"], shots[still]]
                what = f"{name}: displacement, {still}"
                yield self._displacement("samples", what, chain, pair)
        for still in ("slide_blur", "slide_noise", "slide_dim", "slide_salt_pepper"):
            shot = sample(chain.sensor, folder, f"still/{still}")
            errors = corner_errors(chain.markers(shot), shot.truth)
            yield _limited("samples", f"still {still}", errors, HARD_UM)

    @staticmethod
    def _displacement(part: str, name: str, chain: Chain, shots: Sequence[Shot]) -> Row:
        rest, now = ((chain.markers(shot), shot.truth) for shot in shots)
        return _limited(part, name, displacement_errors(rest, now), HARD_UM)

    def _simulated(self) -> Iterable[Row]:
        """Our own frames of the same rig, without and with what makes them hard."""
        chain = self._plain
        shots = {kind: simulated(chain.sensor, kind) for kind in (*KINDS, "twist", "bumps")}
        for kind, shot in shots.items():
            errors = corner_errors(chain.markers(shot), shot.truth)
            yield _limited("simulated", kind, errors, CLEAN_UM)
        for name, camera in HARD.items():
            pair = [
                shots[kind].seen_by(camera, seed) for seed, kind in enumerate(("rest", "slide"))
            ]
            yield self._displacement("simulated", f"{name}: displacement, slide", chain, pair)

    def _refraction(self) -> Iterable[Row]:
        """A distorting lens and 3 mm of plate before 6 mm of gel, with the model and without."""
        for rig in RIGS:
            sensor = with_optics(rig)
            chain = Chain(sensor)
            believed: dict[str, SensorDescription] = {
                "": sensor,
                ", no refraction": without_layers(sensor),
                ", no distortion": without_distortion(sensor),
            }
            grids = {}
            for kind in KINDS:
                shot = simulated(sensor, kind)
                grids[kind] = chain.grids(shot), shot.truth
            for model, description in believed.items():
                yield from _with_model(rig, model, StereoRig(description), grids)

    def _methods(self) -> Iterable[Row]:
        """The weighted point against the middle of the common normal, on the same grids."""
        chain = self._plain
        for name, camera in {"clean": UNCHANGED, **HARD, "one view out of focus": UNEQUAL}.items():
            shots = [
                simulated(chain.sensor, kind).seen_by(camera, seed)
                for seed, kind in enumerate(KINDS)
            ]
            grids = [chain.grids(shot) for shot in shots]
            for method in ("weighted", "common_normal"):
                rig = rig_with(chain.sensor, method)
                found = [rig.triangulate(grid["left"], grid["right"]) for grid in grids]
                pairs = [(m, shot.truth) for m, shot in zip(found, shots, strict=True)]
                for what, errors in errors_by_kind(pairs).items():
                    yield _informed(
                        "methods", f"{name}: {method.replace('_', ' ')}, {what}", errors
                    )

    def _speed(self) -> Iterable[Row]:
        speed = measure_speed(self._plain, simulated(self._plain.sensor, "slide"))
        yield _below("speed", "2 x (400 + 4,560) points, ms", speed.ours_ms, SPEED_MS)
        data = f"{speed.refracted_ms:.3f}"
        yield Row("speed", "the same: distorted, plate and gel, ms", "-", data, None)
        for name, text in speed.notes.items():
            yield Row("speed", name, "-", text, None)

    def _gel(self) -> Iterable[Row]:
        """Rigs that are not as described, calibrated from ten frames at rest at noise 4."""
        for result in gel_calibrations(2 if self.quick else 8):
            after, share = result.after_um, result.share
            met = result.accepted and after <= GEL_UM and share <= GEL_SHARE
            measured = (
                f"{after:.2f} um, {100 * share:.2f} % (before {result.before_um:.0f} um); "
                f"{result.seconds:.0f} s{'' if result.accepted else '; refused'}"
            )
            limit = f"<= {GEL_UM:g} um, {100 * GEL_SHARE:g} %"
            yield Row("gel", f"displacement, {result.name}", limit, measured, met)

    def sweep_points(self) -> Iterable[SweepPoint]:
        """Mean errors over blur and noise, of both methods and of the virtual markers."""
        chain = self._plain
        clean = [simulated(chain.sensor, kind) for kind in KINDS]
        rigs = {method: rig_with(chain.sensor, method) for method in ("weighted", "common_normal")}
        for sweep, (unit, levels, camera) in SWEEPS.items():
            for level in levels[:: 2 if self.quick else 1]:
                shots = [shot.seen_by(camera(level), seed) for seed, shot in enumerate(clean)]
                grids = [chain.grids(shot) for shot in shots]
                errors: dict[str, float] = {}
                for method, rig in rigs.items():
                    pairs = [
                        (rig.triangulate(grid["left"], grid["right"]), shot.truth)
                        for grid, shot in zip(grids, shots, strict=True)
                    ]
                    for what, off in errors_by_kind(pairs).items():
                        if method == "weighted" or what == "corners":
                            errors[f"{what}, {method.replace('_', ' ')}"] = _mean_um(off)
                yield SweepPoint(sweep, unit, level, errors)


def rig_with(sensor: SensorDescription, method: str) -> StereoRig:
    """Triangulation by that method."""
    return StereoRig(replace(sensor, triangulation=replace(sensor.triangulation, method=method)))


def errors_by_kind(pairs: Sequence[tuple[Markers3D, object]]) -> dict[str, Points]:
    """Errors of corners, and of virtual markers by their status."""
    return {
        "corners": joined([corner_errors(*pair) for pair in pairs]),
        "virtual, measured": joined([line_errors(*pair, Status.MEASURED) for pair in pairs]),
        "virtual, predicted": joined([line_errors(*pair, Status.PREDICTED) for pair in pairs]),
    }


def _with_model(rig: str, model: str, stereo: StereoRig, grids: dict) -> Iterable[Row]:
    found = {
        kind: (stereo.triangulate(grid["left"], grid["right"]), truth)
        for kind, (grid, truth) in grids.items()
    }
    for kind, pair in found.items():
        errors, name = corner_errors(*pair), f"{rig}{model}: {kind}"
        if model:
            yield _informed("refraction", name, errors)
        else:
            yield _limited("refraction", name, errors, MODEL_UM)
    for kind in KINDS[1:]:
        errors = displacement_errors(found["rest"], found[kind])
        name = f"{rig}{model}: displacement, {kind}"
        if model:
            yield _informed("refraction", name, errors)
        else:
            yield _limited("refraction", name, errors, MODEL_UM)


def _mean_um(errors: Points) -> float:
    return 1e6 * float(errors.mean()) if len(errors) else float("nan")


def _text(errors: Points) -> str:
    if not len(errors):
        return "none measured"
    most = 1e6 * float(errors.max())
    return f"{_mean_um(errors):.2f} (greatest {most:.1f}; {len(errors)} markers)"


def _limited(part: str, name: str, errors: Points, most_um: float) -> Row:
    met = bool(_mean_um(errors) <= most_um)
    return Row(part, f"{name}, um", f"<= {most_um:g}", _text(errors), met)


def _informed(part: str, name: str, errors: Points) -> Row:
    return Row(part, f"{name}, um", "-", _text(errors), None)


def _below(part: str, name: str, measured: float, most: float) -> Row:
    return Row(part, name, f"<= {most:g}", f"{measured:.3f}", bool(measured <= most))
