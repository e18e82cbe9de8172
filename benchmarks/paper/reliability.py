"""Section IV.F: how much uneven light, noise and blur each method bears."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.scenes.description import MoveBy, Scene, Start, Touch
from cmp_tactile_simulation.scenes.library import load_scene
from paper.chain import Chain
from paper.disturbances import SWEEPS, Disturbance, Sweep, lit
from paper.dot_methods import ALL_METHODS
from paper.experiment import Case, Workplace
from paper.film import Film, Truth
from paper.mechanics import mechanics_of
from paper.method import Method
from paper.picture_measures import light_peak_ratio, pattern_parts, power_snr_db, two_peaks
from paper.scoring import displacement_error, score_markers

__all__ = ["PRESS_FRAMES", "REST_FRAMES", "cases", "expose_and_track", "pressed_ring"]

# Of a print, one repetition by all of its methods.
SECONDS_PER_LEVEL = {"cmp": 1.0, "dmp": 2.3}
REST_FRAMES = 2
# Noise differs with a frame's number: those of a repetition lie below this.
FRAMES_PER_REPETITION = 100
# Of the press, shown in order and judged; the first of them is still before the contact.
PRESS_FRAMES = (0, 4, 6, 8)
# Width of what figures show of a view, px.
STRIP = 110


def pressed_ring(place: Workplace) -> Scene:
    """The ring of section IV.C, pressed elsewhere and then sheared."""
    scene = load_scene("contact_ring")
    rest, press = scene.motion[:2]
    return replace(
        scene,
        name="reliability",
        start=Start(Touch((0.0013, -0.0009), 0.0003)),
        motion=(
            replace(rest, frames=1),
            replace(press, frames=6),
            replace(press, name="shear", frames=2, goal=MoveBy((0.00015, 0.0001, 0.0))),
        ),
        contact_nodes=24 if place.fast else scene.contact_nodes,
    )


def _levels_of(sweep: Sweep, place: Workplace) -> tuple[float, ...]:
    """Levels of a run."""
    return sweep.fast_levels if place.fast else sweep.levels


def cases(place: Workplace) -> Sequence[Case]:
    """One for each disturbance and print."""
    chosen = []
    for sweep in SWEEPS.values():
        levels, repetitions = _levels_of(sweep, place), 1 if place.fast else sweep.repetitions
        for pattern_type, seconds in SECONDS_PER_LEVEL.items():
            arguments = sweep.key, levels, pattern_type, repetitions
            took = 6 + seconds * len(levels) * repetitions
            chosen.append(Case(f"{sweep.key}-{pattern_type}", expose_and_track, arguments, took))
    return chosen


@dataclass(frozen=True)
class _Shots:
    """Frames to be exposed, what is true of them, and the film."""

    film: Film
    press: tuple[RenderedFrame, ...]
    truth: tuple[Truth, ...]

    @classmethod
    def from_workplace(cls, place: Workplace, pattern_type: str) -> _Shots:
        scene = pressed_ring(place)
        mechanics = mechanics_of(scene, place)
        film = Film(scene.sensor, pattern_type)
        surfaces = [mechanics.surface(frame, scene.sensor.pattern) for frame in PRESS_FRAMES]
        rendered = tuple(film.rendered(surface) for surface in surfaces)
        return cls(film, rendered, tuple(film.truth(surface) for surface in surfaces))

    def under(self, disturbance: Disturbance, repetition: int) -> list[NDArray[np.uint8]]:
        """Frames of the gel at rest, then of the press."""
        first = repetition * FRAMES_PER_REPETITION
        lighted = [lit(frame, disturbance, self.truth[0].grids) for frame in self.press]
        shown = [lighted[0]] * REST_FRAMES + lighted
        camera = disturbance.camera
        return [self.film.exposed(frame, first + n, camera) for n, frame in enumerate(shown)]

    def noiseless(self, disturbance: Disturbance) -> NDArray[np.uint8]:
        """A frame at rest without noise."""
        camera = replace(disturbance.camera, read_noise=0.0, salt_and_pepper=0.0)
        return self.film.exposed(lit(self.press[0], disturbance, self.truth[0].grids), 0, camera)


def expose_and_track(
    place: Workplace,
    sweep_key: str,
    levels: tuple[float, ...],
    pattern_type: str,
    repetitions: int,
) -> dict[str, NDArray[np.generic]]:
    """One disturbance of one print at all of its levels.

    Of each method `KEY_found`, `KEY_wrong`, `KEY_visible` markers and `KEY_error`, m, the median
    error of a found marker's displacement (levels, repetitions, frames), and `KEY_referenced`
    (levels, repetitions), whether there was a reference.  Of the first repetition of each level
    `light_peaks`, `peaks` (levels, 2), `snr_db`, and `strips` of its last frame.
    """
    shots = _Shots.from_workplace(place, pattern_type)
    methods = [method for method in ALL_METHODS if method.pattern_type == pattern_type]
    rows: list[dict[str, NDArray[np.generic]]] = []
    for level in levels:
        repeated: list[dict[str, NDArray[np.generic]]] = []
        pictures: dict[str, NDArray[np.generic]] = {}
        for repetition in range(repetitions):
            disturbance = SWEEPS[sweep_key].at(level, repetition)
            images = shots.under(disturbance, repetition)
            pictures = pictures or _of_picture(shots, shots.noiseless(disturbance), images)
            repeated.append(_by_methods(shots, methods, images))
        rows.append(pictures | _stacked(repeated))
    return {"levels": np.array(levels), **_stacked(rows)}


def _stacked(rows: list[dict[str, NDArray[np.generic]]]) -> dict[str, NDArray[np.generic]]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _of_picture(
    shots: _Shots, clean: NDArray[np.uint8], images: list[NDArray[np.uint8]]
) -> dict[str, NDArray[np.generic]]:
    parts = pattern_parts(clean, shots.truth[0].grids)
    noisy = np.concatenate([p.ravel() for p in pattern_parts(images[0], shots.truth[0].grids)])
    last = pattern_parts(images[-1], shots.truth[-1].grids)[0]
    left = (last.shape[1] - STRIP) // 2
    return {
        "light_peaks": np.array(light_peak_ratio(parts)),
        "peaks": np.array(two_peaks(parts)),
        "snr_db": np.array(power_snr_db(np.concatenate([p.ravel() for p in parts]), noisy)),
        "strips": last[:, left : left + STRIP],
    }


def _by_methods(
    shots: _Shots, methods: Sequence[Method], images: list[NDArray[np.uint8]]
) -> dict[str, NDArray[np.generic]]:
    return {
        f"{method.key}_{name}": values
        for method in methods
        for name, values in _measured(shots, method, images).items()
    }


def _measured(
    shots: _Shots, method: Method, images: list[NDArray[np.uint8]]
) -> dict[str, NDArray[np.generic]]:
    rest, press = images[:REST_FRAMES], images[REST_FRAMES:]
    chain = Chain(shots.film.sensor, method)
    try:
        chain.set_reference(rest)
        referenced = True
    except ReferenceFramesError:
        # What is found in the frames is counted all the same.
        referenced = False
    found, wrong, visible, error = [], [], [], []
    for image, truth in zip(press, shots.truth, strict=True):
        measured = chain.measure(image)
        score = score_markers(measured.grids, truth.grids)
        found.append(score.found)
        wrong.append(score.wrong)
        visible.append(score.visible)
        off = np.linalg.norm(displacement_error(measured.surface, truth.surface), axis=-1)
        known = np.isfinite(off).any() and referenced
        error.append(float(np.nanmedian(off)) if known else float("nan"))
    return {
        "found": np.array(found),
        "wrong": np.array(wrong),
        "visible": np.array(visible),
        "error": np.array(error),
        "referenced": np.array(referenced),
    }
