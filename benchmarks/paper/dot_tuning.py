"""Measures what the values of `DotParameters` rest on: python3 -m paper.dot_tuning.

On contacts that no experiment is judged by (dot_tuning_scenes.py).  Writes
benchmarks/results/paper_dot_tuning.md.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from cmp_tactile_simulation.rendering.camera_settings import CameraSettings
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from paper.chain import Chain
from paper.dot_parameters import CENTRINGS, DotParameters
from paper.dot_tracker import (
    AssignmentTracker,
    DotTracker,
    FlowTracker,
    GridOrderTracker,
    NearestTracker,
)
from paper.dot_tuning_scenes import TUNING_SEQUENCES, tuning_scenes
from paper.experiment import Workplace
from paper.film import Film
from paper.mechanics import Mechanics, mechanics_of
from paper.method import CMP, Method
from paper.scoring import displacement_error, score_markers

__all__ = ["main"]

RESULT = Path(__file__).resolve().parent.parent / "results" / "paper_dot_tuning.md"
# Last frames: deepest, farthest aside.  The first one of the sphere is the gel at rest.
FRAMES = {"sphere": (9, 11), "corner": (5,), "cylinder": (8,), "foot": (9,)}
CAMERAS = {
    "default": CameraSettings(),
    "noise 4": CameraSettings(read_noise=4.0),
    "noise 25": CameraSettings(read_noise=25.0),
    "salt 5 %": CameraSettings(salt_and_pepper=0.05),
    "light 4": CameraSettings(light_ratio=4.0, read_noise=2.0),
    "blur 2 px": CameraSettings(blur=2.0),
}
DIAMETERS = (0.28, 0.35, 0.42, 0.5, 0.58)
SEED = 71


@dataclass(frozen=True)
class Score:
    """Errors px of found markers, visible markers that were not found, wrong numbers."""

    error: NDArray[np.float64]
    lost: int
    wrong: int

    def __str__(self) -> str:
        lost = f", {self.lost} lost" if self.lost else ""
        wrong = f", {self.wrong} wrong" if self.wrong else ""
        rms, most = np.sqrt(np.mean(self.error**2)), self.error.max()
        return f"{rms:.4f} ({most:.2f}){lost}{wrong}"


@dataclass(frozen=True)
class Shot:
    """A frame before exposure and what is true of it."""

    rendered: RenderedFrame
    truth: dict[str, Grid]


class Tuning:
    """Frames of the tuning scenes in any print, solved and rendered once."""

    def __init__(self, place: Workplace) -> None:
        self._scenes = tuning_scenes()
        self._place = place
        self.sensor = self._scenes["foot"].sensor
        self.film = cache(self._film)
        self.mechanics = cache(self._mechanics)
        self.shot = cache(self._shot)

    def chain(self, method: Method) -> Chain:
        """A method on the sensor of the scenes."""
        return Chain(self.sensor, method)

    def score(self, parameters: DotParameters, camera: CameraSettings) -> Score:
        """How well the dots of all deformed frames are found, each frame by itself."""
        method = _method(GridOrderTracker, parameters)
        chain, scores = self.chain(method), []
        for name, frames in FRAMES.items():
            for frame in frames:
                shot = self.shot(name, frame, "dmp", parameters.diameter)
                image = self.film("dmp", parameters.diameter).exposed(shot.rendered, frame, camera)
                chain.reset()
                scores.append(_score(chain.measure(image).grids, shot.truth))
        return _joined(scores)

    def sequence(self, tracker: type[DotTracker], parameters: DotParameters, name: str) -> Score:
        """How well the dots keep their numbers along a sequence."""
        scene, frames = TUNING_SEQUENCES[name]
        chain, scores = self.chain(_method(tracker, parameters)), []
        for place, frame in enumerate(frames):
            shot = self.shot(scene, frame, "dmp", parameters.diameter)
            image = self.film("dmp", parameters.diameter).exposed(shot.rendered, frame)
            if place == 0:
                chain.set_reference([image])
            else:
                scores.append(_score(chain.measure(image).grids, shot.truth))
        return _joined(scores)

    def displacement(
        self, method: Method, name: str, camera: CameraSettings
    ) -> tuple[NDArray[np.float64], int]:
        """Errors (n, 3) m of the displacements of a scene's judged frames, and dots lost."""
        diameter = DotParameters().diameter
        film, chain = self.film(method.pattern_type, diameter), self.chain(method)
        rest = self.shot(name, 0, method.pattern_type, diameter)
        chain.set_reference([film.exposed(rest.rendered, 100 + k, camera) for k in range(4)])
        errors, lost = [], 0
        for frame in FRAMES[name]:
            shot = self.shot(name, frame, method.pattern_type, diameter)
            found = chain.measure(film.exposed(shot.rendered, frame, camera))
            surface = self.mechanics(name).surface(frame, self.sensor.pattern)
            error = displacement_error(found.surface, film.truth(surface).surface)
            errors.append(error[np.isfinite(error[..., 0])])
            lost += _score(found.grids, shot.truth).lost
        return np.concatenate(errors), lost

    def _film(self, pattern_type: str, diameter: float) -> Film:
        return Film(self.sensor, pattern_type, seed=SEED, dot_diameter=diameter)

    def _mechanics(self, name: str) -> Mechanics:
        return mechanics_of(self._scenes[name], self._place)

    def _shot(self, name: str, frame: int, pattern_type: str, diameter: float) -> Shot:
        film = self.film(pattern_type, diameter)
        surface = self.mechanics(name).surface(frame, self.sensor.pattern)
        return Shot(film.rendered(surface), dict(film.truth(surface).grids))


def main() -> int:
    """Print all tables, and write them."""
    with tempfile.TemporaryDirectory() as folder:
        place = Workplace(Path(sys.argv[1] if len(sys.argv) > 1 else folder))
        tuning, lines = Tuning(place), [TITLE]
        for part in (_centrings, _diameters, _weights, _numberings, _beside_checkers):
            for line in part(tuning):
                print(line, flush=True)
                lines.append(line)
    RESULT.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


TITLE = """# Tuning of the dot methods

What the values of `benchmarks/paper/dot_parameters.py` rest on, measured by
`cd benchmarks && ../setup/run python3 -m paper.dot_tuning` on contacts that no experiment is judged
by: a sphere of 4 mm off centre, dragged and jumping back; a cuboid's corner; a tilted cylinder that
turns; a foot of 12 mm radius, dragged.  Entries of the first tables: RMS distance from the truth,
px (largest), then visible dots that were not found and wrong numbers where there are any, of all
frames and both views: 3240 dots.
"""


def _centrings(tuning: Tuning) -> Iterator[str]:
    base = DotParameters()
    variants = {name: replace(base, centring=name) for name in CENTRINGS}
    variants["ellipse, smoothed by 0.8 px"] = replace(base, centring="ellipse", smoothing_px=0.8)
    variants["centroid, only nominal curvature"] = replace(base, curvature=False)
    yield from _table(tuning, "Ways to tell the centre", variants)


def _diameters(tuning: Tuning) -> Iterator[str]:
    variants = {f"{d:g} of the pitch": replace(DotParameters(), diameter=d) for d in DIAMETERS}
    yield from _table(tuning, "Diameter of the dots", variants)


def _weights(tuning: Tuning) -> Iterator[str]:
    variants = {
        f"from darkness {threshold:g}, window {window:g} radii": replace(
            DotParameters(), threshold=threshold, window=window
        )
        for threshold in (0.0, 0.05, 0.1, 0.2, 0.35)
        for window in (1.3, 1.6, 1.9)
    }
    yield from _table(tuning, "What weighs in the centroid", variants)


def _table(tuning: Tuning, title: str, variants: dict[str, DotParameters]) -> Iterator[str]:
    yield from _head(title, list(CAMERAS))
    for name, parameters in variants.items():
        cells = [str(tuning.score(parameters, camera)) for camera in CAMERAS.values()]
        yield _row([name, *cells])


def _numberings(tuning: Tuning) -> Iterator[str]:
    """Lost and wrong along sequences, by method and by its own values."""
    yield from _head("Numbering along sequences: lost, wrong", list(TUNING_SEQUENCES))
    for name, tracker, parameters in _trials():
        cells = []
        for sequence in TUNING_SEQUENCES:
            score = tuning.sequence(tracker, parameters, sequence)
            cells.append(f"{score.lost}, {score.wrong}")
        yield _row([name, *cells])


def _trials() -> Iterator[tuple[str, type[DotTracker], DotParameters]]:
    base = DotParameters()
    for gate in (0.5, 0.7, 0.9, 1.2, 2.0):
        yield f"nearest, gate {gate:g}", NearestTracker, replace(base, nearest_gate=gate)
    for gate in (1.2, 2.0, 3.0):
        yield f"assignment, gate {gate:g}", AssignmentTracker, replace(base, assignment_gate=gate)
    for gate in (0.3, 0.45):
        yield f"grid, gate {gate:g}", GridOrderTracker, replace(base, grid_gate=gate)
    for window in (0.8, 1.2, 1.8):
        yield f"flow, window {window:g}", FlowTracker, replace(base, flow_window=window)
    for levels in (1, 3):
        yield f"flow, {levels} halvings", FlowTracker, replace(base, flow_levels=levels)


def _beside_checkers(tuning: Tuning) -> Iterator[str]:
    """Displacement errors of both prints under the same deformation, um."""
    plain = replace(DotParameters(), curvature=False)
    methods = {
        "CMP": CMP,
        "DMP": _method(GridOrderTracker, DotParameters()),
        "DMP, only nominal curvature": _method(GridOrderTracker, plain),
    }
    cameras = {name: CAMERAS[name] for name in ("default", "noise 4", "noise 25")}
    yield from _head("Displacements: RMS x, y, z (largest), um", list(cameras))
    for scene in FRAMES:
        for name, method in methods.items():
            cells = []
            for camera in cameras.values():
                error, lost = tuning.displacement(method, scene, camera)
                rms = np.sqrt(np.mean(error**2, axis=0)) * 1e6
                told = ", ".join(f"{value:.2f}" for value in rms)
                cells.append(f"{told} ({np.abs(error).max() * 1e6:.1f}), {lost} lost")
            yield _row([f"{scene}: {name}", *cells])


def _method(tracker: type[DotTracker], parameters: DotParameters) -> Method:
    make: Callable[..., DotTracker] = tracker
    return Method("", "", "dmp", lambda sensor, view: make(sensor, view, parameters))


def _score(grids: Mapping[str, Grid], truth: dict[str, Grid]) -> Score:
    counts = score_markers(grids, truth)
    errors = []
    for name, grid in grids.items():
        distance = np.linalg.norm(grid.corners - truth[name].corners, axis=-1).ravel()
        errors.append(distance[np.isfinite(distance)])
    lost = counts.visible - counts.found - counts.wrong
    return Score(np.concatenate(errors), lost, counts.wrong)


def _joined(scores: Sequence[Score]) -> Score:
    return Score(
        np.concatenate([score.error for score in scores]),
        sum(score.lost for score in scores),
        sum(score.wrong for score in scores),
    )


def _head(title: str, columns: Sequence[str]) -> Iterator[str]:
    yield f"\n## {title}\n"
    yield _row(["", *columns])
    yield "|" + "---|" * (len(columns) + 1)


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
