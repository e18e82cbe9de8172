"""Sweeps: one property of the frames gets worse, step by step; tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from detectors import Detector, Ours, Result, run_frames, run_pair, run_sequence
from tables import head, line

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.ink import PrintDefects
from hard_frames.covers import Cover
from hard_frames.deformation import jump
from hard_frames.grid_score import join_scores
from hard_frames.library import BLOB_RADIUS, RAGGED_LENGTH
from hard_frames.studio import PatternCase, PatternFrame, PatternStudio, bent, pattern_rig

KINDS = ("slide", "press", "twist")
SIDES = ("left", "top", "right", "bottom")
DIRECTIONS = ((1.0, 0.0), (0.0, -1.0), (-0.7, 0.7))

Make = Callable[[SensorDescription, float], list[PatternCase]]


@dataclass(frozen=True)
class Sweep:
    """What is made worse.

    axis: what the levels are.  cases: of a level.  far: success counts corners two checkers from
    the cover alone.  paired: cases come as rest and deformed, and errors are those of
    displacements.  followed: of each pair, the first frame is tracked before the second.
    """

    name: str
    axis: str
    levels: tuple[float, ...]
    cases: Make
    far: bool = False
    paired: bool = False
    followed: bool = False


@dataclass(frozen=True)
class Point:
    """Result of a detector at one level.  success, found: shares; error: RMSE px; ms: median."""

    sweep: str
    axis: str
    level: float
    detector: str
    views: int
    success: float
    found: float
    wrong: int
    error: float
    ms: float


def _seen(name: str, unit: float = 1.0, over: float = 0.0, **others: float) -> Make:
    """That setting of the camera at the level times a unit, over something."""

    def cases(sensor: SensorDescription, level: float) -> list[PatternCase]:
        camera = CameraSettings(**others | {name: over + unit * level})  # type: ignore[arg-type]
        return [bent(sensor, kind, camera=camera) for kind in KINDS]

    return cases


def _printed(make: Callable[[float], PrintDefects]) -> Make:
    return lambda sensor, level: [
        replace(bent(sensor, kind), defects=make(level), seed=seed, frame=number)
        for seed in range(2)
        for number, kind in enumerate(("rest", KINDS[seed]))
    ]


def _hidden(sensor: SensorDescription, level: float) -> list[PatternCase]:
    return [
        bent(sensor, KINDS[number % 3], cover=Cover(side, level) if level else None)
        for number, side in enumerate(SIDES)
    ]


def _jumps(sensor: SensorDescription, level: float) -> list[PatternCase]:
    return [
        PatternCase("jump", sensor, jump(sensor, (x * length, y * length)))
        for x, y in DIRECTIONS
        for length in (0.0, level)
    ]


def _sizes(sensor: SensorDescription, level: float) -> list[PatternCase]:  # noqa: ARG001
    rig = pattern_rig(int(level), int(level))
    return [bent(rig, kind) for kind in KINDS[:2]]


SWEEPS = (
    Sweep("blur", "sigma, px", (0.5, 1, 1.5, 2, 3, 4, 5), _seen("blur")),
    Sweep("noise", "sigma, grey levels", (0, 2, 4, 8, 16, 24, 32), _seen("read_noise")),
    Sweep("salt and pepper", "share of pixels, %", (0, 0.2, 1, 3, 10, 20),
          _seen("salt_and_pepper", 0.01)),
    Sweep("light", "brightest over darkest", (1, 2, 3, 5, 8, 12),
          _seen("light_ratio", vignette=0.3)),
    Sweep("contrast", "light - dark, grey levels", (160, 80, 40, 20, 12, 8),
          _seen("light_level", over=60.0, dark_level=60.0)),
    Sweep("occlusion", "share hidden", (0, 0.1, 0.2, 1 / 3, 0.45, 0.6), _hidden, far=True),
    Sweep("missing ink", "blobs on the pattern", (0, 10, 20, 40, 80),
          _printed(lambda v: PrintDefects(int(v), 0, BLOB_RADIUS)), paired=True),
    Sweep("ragged edges", "rms, mm", (0, 0.01, 0.02, 0.04, 0.06, 0.08),
          _printed(lambda v: PrintDefects(0, 0, BLOB_RADIUS, v * 1e-3, RAGGED_LENGTH)),
          paired=True),
    Sweep("jump", "checkers in one frame", (0.25, 0.5, 1, 1.5, 2, 3), _jumps, followed=True),
    Sweep("grid size", "corners along a side", (4, 7, 14, 20, 30, 45, 60), _sizes),
)  # fmt: skip


@dataclass
class SweepRun:
    """Runs sweeps.  image_cap: views of a level that each peer gets; seconds_cap: for a sweep."""

    sensor: SensorDescription
    detectors: Sequence[Detector]
    image_cap: int
    seconds_cap: float
    report: Callable[[str], None] = print

    def points(self, sweep: Sweep) -> Iterable[Point]:
        """All levels of all detectors; peers that have used up their time are left out."""
        studio = PatternStudio()
        detectors = list(self.detectors)
        if sweep.followed:
            detectors = [Ours("cmp_tactile, following", cold=False), *detectors]
        spent = dict.fromkeys((detector.name for detector in detectors), 0.0)
        for level in sweep.levels:
            frames = [studio.photograph(case) for case in sweep.cases(self.sensor, level)]
            for detector in detectors:
                mine = isinstance(detector, Ours)
                if spent[detector.name] > self.seconds_cap and not mine:
                    continue
                began = perf_counter()
                some = frames if mine else frames[: self._cap(sweep)]
                if detector.able(some[0].sensor):
                    yield self._point(sweep, level, detector, some)
                spent[detector.name] += perf_counter() - began
                if spent[detector.name] > self.seconds_cap and not mine:
                    cap = f"{self.seconds_cap:g} s"
                    self.report(f"{sweep.name}: {detector.name} stopped at {level:g} after {cap}")

    def _cap(self, sweep: Sweep) -> int:
        """Frames of a level for a peer, two views each; of a jump only the second one counts."""
        count = self.image_cap if sweep.followed else self.image_cap // 2
        return max(2, count - count % 2 * (sweep.followed or sweep.paired))

    def _point(
        self, sweep: Sweep, level: float, detector: Detector, frames: Sequence[PatternFrame]
    ) -> Point:
        run = _run_jumps if sweep.followed else run_frames
        result = run(detector, frames)
        score = result.score
        error = score.corner_rmse
        if sweep.paired:
            pairs = zip(frames[::2], frames[1::2], strict=True)
            errors = np.concatenate([run_pair(detector, *pair) for pair in pairs])
            error = float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
        complete = score.complete_far if sweep.far else score.complete
        found, all_of = (
            (score.found_far, score.far) if sweep.far else (score.found_visible, score.visible)
        )
        shares = complete / max(score.grids, 1), found / max(all_of, 1)
        place = sweep.name, sweep.axis, level, detector.name, score.grids
        return Point(*place, *shares, score.wrong, error, result.milliseconds)


def _run_jumps(detector: Detector, frames: Sequence[PatternFrame]) -> Result:
    """The second frame of each pair, after the first was seen."""
    results = []
    for before, after in zip(frames[::2], frames[1::2], strict=True):
        if isinstance(detector, Ours) and detector.follows:
            results.append(run_sequence(detector, [before, after])[1])
        else:
            results.append(run_frames(detector, [after]))
    seconds = tuple(second for result in results for second in result.seconds)
    return Result(join_scores(result.score for result in results), seconds)


def write_markdown(points: Sequence[Point], versions: Sequence[str], path: Path) -> None:
    """A table for each sweep: per detector and level, complete views, RMSE and time."""
    lines = ["# Gridline extraction", "", *(f"- {version}" for version in versions)]
    lines += [
        "",
        "Each entry: views with every visible corner found and none wrong; RMSE of the corners",
        "that were found, px (of their displacement, where prints are flawed); median time of the",
        "processor for a view, ms. `w`: number of corners with wrong numbers.",
    ]
    lines += ["", "## How far each gets", ""]
    lines += [
        "The hardest level up to which every view was complete; `+` where time was up then.",
        "",
    ]
    lines += _summary(points)
    for sweep in dict.fromkeys(point.sweep for point in points):
        mine = [point for point in points if point.sweep == sweep]
        levels = list(dict.fromkeys(point.level for point in mine))
        lines += ["", f"## {sweep.capitalize()}", ""]
        lines.append(head(mine[0].axis, *(f"{level:.3g}" for level in levels)))
        for detector in dict.fromkeys(point.detector for point in mine):
            by_level = {point.level: point for point in mine if point.detector == detector}
            lines.append(line(detector, *(_cell(by_level.get(level)) for level in levels)))
    path.write_text("\n".join(lines) + "\n")


def _summary(points: Sequence[Point]) -> list[str]:
    """The hardest level up to which all views of all levels were complete, per sweep."""
    detectors = list(dict.fromkeys(point.detector for point in points))
    lines = [head("", *detectors)]
    for sweep in dict.fromkeys(point.sweep for point in points):
        mine = [point for point in points if point.sweep == sweep]
        hardest = mine[-1].level
        reached = [
            _reached([point for point in mine if point.detector == detector], hardest)
            for detector in detectors
        ]
        lines.append(line(f"{sweep}: {mine[0].axis}", *reached))
    return lines


def _reached(points: Sequence[Point], hardest: float) -> str:
    """The last level before the first failure; with + where none failed but not all were run."""
    if not points:
        return "-"
    failed = next((k for k, point in enumerate(points) if point.success < 1), len(points))
    if failed == 0:
        return "none"
    more = "+" if failed == len(points) and points[-1].level != hardest else ""
    return f"{points[failed - 1].level:.3g}{more}"


def _cell(point: Point | None) -> str:
    if point is None:
        return "-"
    wrong = f", {point.wrong} w" if point.wrong else ""
    error = "" if np.isnan(point.error) else f", {point.error:.3f}"
    return f"{100 * point.success:.0f} %{error}, {point.ms:.1f}{wrong}"
