"""Section IV.F: how much uneven light, weak contrast and noise each method bears."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.measured import Grid
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.scenes.description import MoveBy, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Chain, Method, displacement_error, score_markers
from paper.dot_tracking import ALL_METHODS
from paper.experiment import Case, Workplace
from paper.gel import mechanics_of
from paper.sequence import PrintedGel, Truth

# Across the frame in which the light fades, one for each repetition: along y each view has all of
# it, along x one view is the dark one.
DIRECTIONS = (math.pi / 2, 0.0, math.pi / 4)
GOOD = CameraSettings()


@dataclass(frozen=True)
class Disturbance:
    """The camera, and a light that fades linearly across the pattern.

    light_ratio: darkest over brightest illumination of the pattern, both views together; the
    camera's own setting is that of the whole frame, of which the pattern fills a part.
    direction: from the frame's x axis (right) towards y (down), rad.
    """

    camera: CameraSettings
    light_ratio: float = 1.0
    direction: float = 0.0


@dataclass(frozen=True)
class Sweep:
    """Levels of one disturbance, from good to bad.

    level: what it is called, with its unit.  disturbance: of a level.
    repetitions: of a full run, each with noise of its own.
    fast_levels: of the quick run.  paper_limit: level up to which the paper's algorithm worked.
    logarithmic: how the level's axis is drawn.  percent: levels are shares.
    """

    key: str
    title: str
    level: str
    levels: tuple[float, ...]
    fast_levels: tuple[float, ...]
    disturbance: Callable[[float], Disturbance]
    repetitions: int
    paper_limit: float | None = None
    logarithmic: bool = False
    percent: bool = False

    def at(self, level: float, repetition: int) -> Disturbance:
        """A level; repetitions differ in where the light comes from."""
        direction = DIRECTIONS[repetition % len(DIRECTIONS)]
        return replace(self.disturbance(level), direction=direction)


def lit(frame: RenderedFrame, disturbance: Disturbance, grids: Mapping[str, Grid]) -> RenderedFrame:
    """The frame in the disturbance's light; grids: where the pattern is in the views at rest."""
    if disturbance.light_ratio == 1:
        return frame
    along = math.cos(disturbance.direction), math.sin(disturbance.direction)
    corners = [grid.corners_frame.reshape(-1, 2) @ along for grid in grids.values()]
    first, last = np.nanmin(corners), np.nanmax(corners)
    rows, cols = (np.arange(side) / frame.fineness for side in frame.grey.shape)
    way = (cols * along[0] + (rows * along[1])[:, None] - first) / (last - first)
    light = 1 - (1 - disturbance.light_ratio) * way.clip(0, 1)
    return replace(frame, grey=(frame.grey * light).astype(np.float32))


def _light(ratio: float) -> Disturbance:
    return Disturbance(GOOD, ratio)


def _visibility(visibility: float) -> Disturbance:
    dark = GOOD.light_level * (1 - visibility) / (1 + visibility)
    return Disturbance(replace(GOOD, dark_level=dark))


def _impulses(share: float) -> Disturbance:
    return Disturbance(replace(GOOD, salt_and_pepper=share))


# Michelson's (light - dark) / (light + dark) of the simulated print: 205 and 45 of 255.
VISIBILITY = (GOOD.light_level - GOOD.dark_level) / (GOOD.light_level + GOOD.dark_level)

SWEEPS: Mapping[str, Sweep] = MappingProxyType(
    {
        sweep.key: sweep
        for sweep in (
            Sweep(
                "light",
                "Uneven light",
                "darkest over brightest illumination",
                (1.0, 0.7, 0.4, 0.3, 0.2, 0.1, 0.07, 0.05, 0.03, 0.01),
                (1.0, 0.4, 0.03),
                _light,
                3,
                paper_limit=0.4,
                logarithmic=True,
            ),
            Sweep(
                "contrast",
                "Weak contrast",
                "visibility of the print",
                (VISIBILITY, 0.3, 0.1, 0.05, 0.03, 0.02, 0.01),
                (VISIBILITY, 0.02),
                _visibility,
                2,
                logarithmic=True,
            ),
            Sweep(
                "salt_and_pepper",
                "Salt and pepper",
                "pixels spoilt",
                (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7),
                (0.0, 0.05, 0.2, 0.4),
                _impulses,
                3,
                paper_limit=0.05,
                percent=True,
            ),
        )
    }
)


def pattern_parts(image: NDArray[np.uint8], grids: Mapping[str, Grid]) -> list[NDArray[np.uint8]]:
    """Of a frame (H, W), the rectangle in each view that holds all of its true corners."""
    parts = []
    for grid in grids.values():
        corners = grid.corners_frame.reshape(-1, 2)
        (left, top), (right, bottom) = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
        parts.append(image[int(top) : int(bottom) + 1, int(left) : int(right) + 1])
    return parts


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
    """Frames to be exposed, what is true of them, and the printed gel."""

    gel: PrintedGel
    press: tuple[RenderedFrame, ...]
    truth: tuple[Truth, ...]

    @classmethod
    def from_workplace(cls, place: Workplace, pattern_type: str) -> _Shots:
        scene = pressed_ring(place)
        mechanics = mechanics_of(scene, place)
        gel = PrintedGel(scene.sensor, pattern_type)
        surfaces = [mechanics.surface(frame, scene.sensor.pattern) for frame in PRESS_FRAMES]
        rendered = tuple(gel.rendered(surface) for surface in surfaces)
        return cls(gel, rendered, tuple(gel.truth(surface) for surface in surfaces))

    def under(self, disturbance: Disturbance, repetition: int) -> list[NDArray[np.uint8]]:
        """Frames of the gel at rest, then of the press."""
        first = repetition * FRAMES_PER_REPETITION
        lighted = [lit(frame, disturbance, self.truth[0].grids) for frame in self.press]
        shown = [lighted[0]] * REST_FRAMES + lighted
        camera = disturbance.camera
        return [self.gel.exposed(frame, first + n, camera) for n, frame in enumerate(shown)]


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
    (levels, repetitions), whether there was a reference.  `strips`: of the last
    frame of each level's first repetition.
    """
    shots = _Shots.from_workplace(place, pattern_type)
    methods = [method for method in ALL_METHODS if method.pattern_type == pattern_type]
    rows: list[dict[str, NDArray[np.generic]]] = []
    strips: list[NDArray[np.uint8]] = []
    for level in levels:
        repeated: list[dict[str, NDArray[np.generic]]] = []
        for repetition in range(repetitions):
            disturbance = SWEEPS[sweep_key].at(level, repetition)
            images = shots.under(disturbance, repetition)
            if not repetition:
                strips.append(_strip(shots, images[-1]))
            repeated.append(_by_methods(shots, methods, images))
        rows.append(_joined(repeated))
    return {"levels": np.array(levels), "strips": np.stack(strips), **_joined(rows)}


def _joined(rows: list[dict[str, NDArray[np.generic]]]) -> dict[str, NDArray[np.generic]]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _strip(shots: _Shots, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The middle of the left view of the last frame."""
    last = pattern_parts(image, shots.truth[-1].grids)[0]
    left = (last.shape[1] - STRIP) // 2
    return last[:, left : left + STRIP]


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
    chain = Chain(shots.gel.sensor, method)
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
