"""Limits of the tracker, each with what was measured."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from broken import BROKEN_KINDS, run_broken
from detectors import Ours, run_frames, run_inspected, run_pair, run_sequence
from tables import Limit, LimitRun

from cmp_tactile_processing.errors import FrameError
from cmp_tactile_processing.geometry.split import split_frame
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.tracking.tracker import GridTracker
from cmp_tactile_simulation.rendering.camera import CameraSettings
from hard_frames.covers import COVERS, Cover
from hard_frames.grid_score import GridScore, join_scores
from hard_frames.library import (
    SEQUENCES,
    bad_views,
    cases_of,
    flawed_pairs,
    load_sample,
    misdescribed,
    sample_names,
    sequence_of,
)
from hard_frames.studio import PatternFrame, PatternStudio, degrade

# Kinds of which every view must be complete.
COMPLETE_KINDS = (
    "clean", "small spheres", "light 0.35", "light 0.2", "blur 2", "blur 3", "blur 4",
    "salt and pepper 1 %", "salt and pepper 10 %", "noise 4", "noise 8", "noise 16",
    "missing ink 40", "blobs 40", "ragged 0.015 mm", "ragged 0.06 mm", "clutter, glare, margin",
    "dirt on the optics", "low contrast", "dark", "all at once", "other rigs",
)  # fmt: skip
# What is added to sample frames; their own camera has blurred and lit them already.
SAMPLE_CAMERAS = {
    "blur 4": CameraSettings(vignette=0.0, blur=4.0),
    "light 0.2": CameraSettings(vignette=0.0, blur=0.0, light_ratio=5.0),
    "noise 16": CameraSettings(vignette=0.0, blur=0.0, read_noise=16.0),
    "salt and pepper 10 %": CameraSettings(vignette=0.0, blur=0.0, salt_and_pepper=0.1),
}
SPOTS = "missing ink 40"
SAMPLE_STILLS = ("rest", "press", "slide", "twist", "bumps")


@dataclass
class TrackingLimits(LimitRun):
    """Measures all limits of our tracker.  samples: folder of sample frames, or None."""

    sensor: SensorDescription
    samples: Path | None
    seeds: Sequence[int] = (0,)
    detector: str = "saddle_lattice"
    scores: list[GridScore] = field(default_factory=list)

    PARTS: ClassVar[tuple[str, ...]] = (
        "found", "sequences", "hidden", "wrong", "corners", "virtual", "displacement",
        "bad_input", "broken",
    )  # fmt: skip

    def _wrong(self) -> Iterable[Limit]:
        total = join_scores(self.scores)
        yield _below("wrong numbers in all of the above", total.wrong, 0, "{:.0f}")

    @cached_property
    def _studio(self) -> PatternStudio:
        return PatternStudio()

    @cached_property
    def _fresh(self) -> Ours:
        return Ours("from scratch", follow=False, detector=self.detector)

    def _sample(self, name: str) -> PatternFrame:
        if self.samples is None:
            msg = f"{name}: found no folder of sample frames"
            raise FrameError(msg)
        return load_sample(self.sensor, self.samples, name)

    def _samples(self, kind: str) -> list[PatternFrame]:
        """The sample frames of a subfolder; none where no folder is given."""
        names = sample_names(self.samples, kind) if self.samples else []
        return [self._sample(name) for name in names]

    def _frames(self, kind: str) -> list[PatternFrame]:
        return [
            self._studio.photograph(case)
            for seed in self.seeds
            for case in cases_of(kind, self.sensor, seed)
        ]

    def _run(self, frames: Sequence[PatternFrame]) -> GridScore:
        score = run_frames(self._fresh, frames).score
        self.scores.append(score)
        return score

    @cached_property
    def _by_kind(self) -> dict[str, GridScore]:
        return {kind: self._run(self._frames(kind)) for kind in COMPLETE_KINDS}

    def _found(self) -> Iterable[Limit]:
        for kind, score in self._by_kind.items():
            yield _complete(kind, score)
        if self.samples is None:
            return
        yield _complete("sample stills", self._run(self._samples("still")))
        for name, camera in SAMPLE_CAMERAS.items():
            frames = [degrade(self._sample(f"still/{still}"), camera) for still in SAMPLE_STILLS]
            yield _complete(f"sample stills, {name}", self._run(frames))

    def _sequences(self) -> Iterable[Limit]:
        following = Ours("following", cold=False, detector=self.detector)
        for kind in SEQUENCES:
            frames = [
                self._studio.photograph(case)
                for seed in self.seeds
                for case in sequence_of(kind, self.sensor, seed)
            ]
            yield self._followed(kind, following, frames)
        if grasp := self._samples("grasp"):
            yield self._followed("sample grasp", following, grasp)

    def _followed(self, name: str, following: Ours, frames: Sequence[PatternFrame]) -> Limit:
        score = join_scores(part.score for part in run_sequence(following, frames))
        self.scores.append(score)
        return _complete(f"followed: {name}", score, far=name.startswith("hidden"))

    def _hidden(self) -> Iterable[Limit]:
        frames = self._frames("hidden")
        yield _complete("a part hidden", self._run(frames), far=True)
        if self.samples is None:
            return
        for still in SAMPLE_STILLS[:2]:
            plain = CameraSettings(vignette=0.0, blur=0.0)
            frames = [
                degrade(self._sample(f"still/{still}"), plain, Cover(shape, 0.3, 60.0))
                for shape in COVERS
            ]
            yield _complete(f"sample {still}, a part hidden", self._run(frames), far=True)

    def _corners(self) -> Iterable[Limit]:
        kinds = self._by_kind
        yield _below("corners RMSE, clean, px", kinds["clean"].corner_rmse, 0.012)
        yield _below("corners max, clean, px", kinds["clean"].corner_max, 0.08)
        for kind, most in (("blur 3", 0.03), ("noise 4", 0.03), ("noise 16", 0.12)):
            yield _below(f"corners RMSE, {kind}, px", kinds[kind].corner_rmse, most)
        if self.samples is not None:
            clean = self._run([self._sample(f"still/{name}") for name in SAMPLE_STILLS])
            yield _below("corners RMSE, sample stills, px", clean.corner_rmse, 0.012)
            yield _below("corners max, sample stills, px", clean.corner_max, 0.08)

    def _virtual(self) -> Iterable[Limit]:
        most = {"clean": 0.012, "small spheres": 0.015, "blur 2": 0.007}
        scores = {kind: self._by_kind[kind] for kind in most}
        if self.samples is not None:
            stills = [self._sample(f"still/{name}") for name in SAMPLE_STILLS]
            scores["sample stills"] = self._run(stills[:-1])
            scores["sample bumps"] = self._run(stills[-1:])
            most |= {"sample stills": 0.012, "sample bumps": 0.015}
        for kind, score in scores.items():
            yield _below(f"virtual markers RMS, {kind}, px", score.virtual_rms, most[kind])
            yield _below(f"virtual markers p99, {kind}, px", score.virtual_p99, 0.05)

        inspected = []
        for case in cases_of(SPOTS, self.sensor, self.seeds[0]):
            shown = map(self._studio.photograph, (replace(case, deformation=()), case))
            inspected.append(run_inspected(self._fresh, *shown))
        rms = join_scores(inspected).virtual_rms
        yield _below(f"virtual markers RMS, {SPOTS}, inspected, px", rms, 0.05)

    def _displacement(self) -> Iterable[Limit]:
        pairs = {
            f"flawed print {number}": [self._studio.photograph(case) for case in pair]
            for number, pair in enumerate(flawed_pairs(self.sensor, self.seeds[0]), 1)
        }
        if self.samples is not None:
            worn = [self._sample(f"still/worn_{name}") for name in ("rest", "slide")]
            pairs["sample worn"] = worn
        for name, (first, second) in pairs.items():
            errors = run_pair(self._fresh, first, second)
            rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan")
            yield _below(f"displacement RMS, {name}, px", rms, 0.04)

    def _bad_input(self) -> Iterable[Limit]:
        frame = self._studio.photograph(cases_of("clean", self.sensor)[0])
        guessed, unnamed, raised, count = 0, 0, 0, 0
        for view, truth in frame.truth.items():
            if truth.placement is None:
                continue
            image = split_frame(frame.image, truth.placement)
            trials = [(self.sensor, bad) for bad in bad_views(image).values()]
            trials += [(rig, image) for rig in misdescribed(self.sensor).values()]
            for rig, shown in trials:
                count += 1
                tracking = replace(rig.tracking, detector=self.detector)
                try:
                    grid = GridTracker(replace(rig, tracking=tracking), view).track(shown)
                except Exception:  # noqa: BLE001 - whatever is raised is what is counted
                    raised += 1
                    continue
                guessed += int((grid.corner_status != 0).any())
                unnamed += not grid.fault.value
        yield _below(f"bad input ({count} views): exceptions", raised, 0, "{:.0f}")
        yield _below(f"bad input ({count} views): with any corner", guessed, 0, "{:.0f}")
        yield _below(f"bad input ({count} views): without a fault", unnamed, 0, "{:.0f}")

    def _broken(self) -> Iterable[Limit]:
        tracking = replace(self.sensor.tracking, detector=self.detector)
        sensor = replace(self.sensor, tracking=tracking)
        frames = [*self._frames("clean"), *self._frames("clutter, glare, margin")]
        frames += [*self._samples("still"), *self._samples("grasp")]
        for kind in BROKEN_KINDS:
            score = run_broken(kind, frames, sensor, seed=self.seeds[0])
            measured = (
                f"{score.silent} of {score.trials} frames, {score.wrong} corners "
                f"({score.right} right, {score.faults} views with a fault)"
            )
            yield Limit(f"{kind}: silently misnumbered", "<= 0", measured, score.silent == 0)
            yield _below(f"{kind}: wrong forces without a flag", score.wrong_forces, 0, "{:.0f}")


def _below(name: str, measured: float, most: float, form: str = "{:.4f}") -> Limit:
    return Limit(name, f"<= {most:g}", form.format(measured), bool(measured <= most))


def _complete(name: str, score: GridScore, far: bool = False) -> Limit:
    found = score.complete_far if far else score.complete
    count, corners = (score.found_far, score.far) if far else (score.found_visible, score.visible)
    measured = f"{found}/{score.grids} views, {count}/{corners} corners, {score.wrong} wrong"
    if score.filled and not far:
        measured += f", {score.filled} predicted"
    what = "all corners two cells away" if far else "all visible corners"
    return Limit(f"{name}: {what}", "100 %", measured, found == score.grids)
