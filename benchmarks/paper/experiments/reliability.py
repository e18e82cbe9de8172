"""IV.F: uneven light, weak contrast and impulses up to which each method works."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.measured import Grid
from cmp_tactile_simulation.rendering.camera import CameraSettings
from cmp_tactile_simulation.rendering.renderer import RenderedFrame
from cmp_tactile_simulation.scenes.description import MoveBy, Scene, Start, Touch
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import CMP, Chain, Method, score_markers
from paper.dot_trackers import ALL_METHODS
from paper.lab import Arrays, Lab, Workplace, mechanics_of
from paper.page import PAPER_COLOUR, Page, legend, look, panels
from paper.sequence import PrintedGel, Truth

TITLE = "IV.F: Reliability in uneven light and noise"
# Across the frame in which the light fades, one for each repetition: along y each view has all of
# it, along x one view is the dark one.
DIRECTIONS = (math.pi / 2, 0.0, math.pi / 4)
GOOD = CameraSettings()
REST_FRAMES = 2
# Noise differs with a frame's number: those of a repetition lie below this.
FRAMES_PER_REPETITION = 100
# Of the press, shown in order and judged; the first of them is still before the contact.
PRESS_FRAMES = (0, 4, 6, 8)
HALF = 0.5


@dataclass(frozen=True)
class Sweep:
    """Levels of one disturbance, from good to bad.

    level: what it is called, with its unit.  camera: of a level; light_ratio: whether levels are
    darkest over brightest illumination of the pattern, both views together, instead.
    repetitions: of a full run, each with other noise and another direction of the light.
    paper_limit: level up to which the paper's algorithm worked.
    """

    title: str
    level: str
    levels: tuple[float, ...]
    fast_levels: tuple[float, ...]
    camera: Callable[[float], CameraSettings]
    repetitions: int
    light_ratio: bool = False
    paper_limit: float | None = None
    percent: bool = False

    def text(self, level: float) -> str:
        """A level as a reader takes it."""
        return f"{100 * level:.0f} %" if self.percent else f"{level:.2g}"


def _visibility(visibility: float) -> CameraSettings:
    return replace(GOOD, dark_level=GOOD.light_level * (1 - visibility) / (1 + visibility))


# Michelson's (light - dark) / (light + dark) of the simulated print: 205 and 45 of 255.
VISIBILITY = (GOOD.light_level - GOOD.dark_level) / (GOOD.light_level + GOOD.dark_level)
SWEEPS = {
    "light": Sweep(
        "Uneven light",
        "darkest over brightest illumination",
        (1.0, 0.7, 0.4, 0.3, 0.2, 0.1, 0.07, 0.05, 0.03, 0.01),
        (1.0, 0.4, 0.03),
        lambda _: GOOD,
        3,
        light_ratio=True,
        paper_limit=0.4,
    ),
    "contrast": Sweep(
        "Weak contrast",
        "visibility of the print",
        (VISIBILITY, 0.3, 0.1, 0.05, 0.03, 0.02, 0.01),
        (VISIBILITY, 0.02),
        _visibility,
        2,
    ),
    "salt_and_pepper": Sweep(
        "Salt and pepper",
        "pixels spoilt",
        (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7),
        (0.0, 0.05, 0.2, 0.4),
        lambda share: replace(GOOD, salt_and_pepper=share),
        3,
        paper_limit=0.05,
        percent=True,
    ),
}


def run(lab: Lab, page: Page) -> None:
    """Go through the levels of all sweeps, and report."""
    cases = []
    for key, sweep in SWEEPS.items():
        levels = sweep.fast_levels if lab.fast else sweep.levels
        repetitions = 1 if lab.fast else sweep.repetitions
        cases += [(key, levels, kind, repetitions) for kind in ("cmp", "dmp")]
    found = dict(zip([case[:3:2] for case in cases], lab.compute(endure, cases), strict=True))
    endurances = {
        (key, method.key): Endurance.from_arrays(found[key, method.pattern_type], method.key)
        for key in SWEEPS
        for method in ALL_METHODS
    }
    page.prose("reliability", "setup", rest=REST_FRAMES, press=len(PRESS_FRAMES))
    page.prose("reliability", "definitions")
    _limits(endurances, page)
    page.figure(_curves(endurances), "reliability.limits")
    page.prose("reliability", "shared")
    claims({key: endurances[key, CMP.key] for key in SWEEPS}, page)
    page.departures("reliability")


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


def lit(
    frame: RenderedFrame, ratio: float, direction: float, grids: Mapping[str, Grid]
) -> RenderedFrame:
    """The frame in a light that falls linearly across the pattern to that share.

    direction: from the frame's x axis (right) towards y (down), rad.  grids: of the gel at rest.
    """
    along = math.cos(direction), math.sin(direction)
    corners = [grid.corners_frame.reshape(-1, 2) @ along for grid in grids.values()]
    first, last = np.nanmin(corners), np.nanmax(corners)
    rows, cols = (np.arange(side) / frame.fineness for side in frame.grey.shape)
    way = (cols * along[0] + (rows * along[1])[:, None] - first) / (last - first)
    light = 1 - (1 - ratio) * way.clip(0, 1)
    return replace(frame, grey=(frame.grey * light).astype(np.float32))


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

    def under(self, sweep: Sweep, level: float, repetition: int) -> list[NDArray[np.uint8]]:
        """Frames of the gel at rest, then of the press."""
        direction, lighted = DIRECTIONS[repetition % len(DIRECTIONS)], list(self.press)
        if sweep.light_ratio:
            grids = self.truth[0].grids
            lighted = [lit(frame, level, direction, grids) for frame in lighted]
        shown, first = [lighted[0]] * REST_FRAMES + lighted, repetition * FRAMES_PER_REPETITION
        camera = sweep.camera(level)
        return [self.gel.exposed(frame, first + n, camera) for n, frame in enumerate(shown)]


def endure(
    place: Workplace, key: str, levels: tuple[float, ...], pattern_type: str, repetitions: int
) -> dict[str, NDArray[np.generic]]:
    """One disturbance of one print at all of its levels.

    `levels`; of each method `KEY_found`, `KEY_wrong`, `KEY_visible` (levels, repetitions, frames)
    markers, and `KEY_referenced` (levels, repetitions), whether there was a reference.
    """
    shots = _Shots.from_workplace(place, pattern_type)
    result: dict[str, NDArray[np.generic]] = {"levels": np.array(levels)}
    images = [
        [shots.under(SWEEPS[key], level, repetition) for repetition in range(repetitions)]
        for level in levels
    ]
    for method in ALL_METHODS:
        if method.pattern_type == pattern_type:
            rows = [[_measured(shots, method, shown) for shown in row] for row in images]
            for n, name in enumerate(("found", "wrong", "visible", "referenced")):
                result[f"{method.key}_{name}"] = np.array([[one[n] for one in row] for row in rows])
    return result


def _measured(
    shots: _Shots, method: Method, images: list[NDArray[np.uint8]]
) -> tuple[list[int], list[int], list[int], bool]:
    chain, referenced = Chain(shots.gel.sensor, method), True
    try:
        chain.set_reference(images[:REST_FRAMES])
    except CalibrationError:
        # What is found in the frames is counted all the same.
        referenced = False
    scores = [
        score_markers(chain.measure(image).grids, truth.grids)
        for image, truth in zip(images[REST_FRAMES:], shots.truth, strict=True)
    ]
    found, wrong = [score.found_visible for score in scores], [score.wrong for score in scores]
    return found, wrong, [score.visible for score in scores], referenced


@dataclass(frozen=True)
class Endurance:
    """How a method fares from level to level, from good to bad, (L,) each.

    success: share of the frames in which every visible marker is found and none bears a wrong
    number, of a gel that has its reference.  found: markers found of those visible.
    """

    levels: NDArray[np.float64]
    success: NDArray[np.float64]
    found: NDArray[np.float64]

    @classmethod
    def from_arrays(cls, arrays: Arrays, method: str) -> Endurance:
        """From the result of `endure`."""
        found, wrong, visible, referenced = (
            arrays[f"{method}_{name}"] for name in ("found", "wrong", "visible", "referenced")
        )
        works = (found == visible) & (wrong == 0) & referenced[..., None]
        shares = found.sum(axis=(1, 2)) / visible.sum(axis=(1, 2))
        return cls(arrays["levels"], works.mean(axis=(1, 2)), shares)

    @property
    def fails_at(self) -> int | None:
        """Index of the first level where a marker is lost or has a wrong number in any frame."""
        return _first(self.success < 1)

    @property
    def half_lost_at(self) -> int | None:
        """Index of the first level where half of all markers are lost, or more."""
        return _first(self.found <= HALF)

    @property
    def bears(self) -> float | None:
        """The worst level before it begins to fail; None where it fails at the first."""
        first = self.fails_at
        if first == 0:
            return None
        return float(self.levels[-1 if first is None else first - 1])


def _first(where: NDArray[np.bool_]) -> int | None:
    return int(np.argmax(where)) if where.any() else None


Endurances = Mapping[tuple[str, str], Endurance]


def _limits(endurances: Endurances, page: Page) -> None:
    """Where each method begins to fail, and where half of its markers are lost."""
    rows = [
        (m.label, *(_limit(sweep, endurances[key, m.key]) for key, sweep in SWEEPS.items()))
        for m in ALL_METHODS
    ]
    sweeps = [f"{sweep.title}: {sweep.level}" for sweep in SWEEPS.values()]
    page.table("reliability.limits", rows, sweeps=sweeps)


def _limit(sweep: Sweep, endurance: Endurance) -> str:
    first, half = endurance.fails_at, endurance.half_lost_at
    if first is None:
        return f"none to {sweep.text(endurance.levels[-1])}"
    lost = "never" if half is None else sweep.text(endurance.levels[half])
    return f"{sweep.text(endurance.levels[first])} ({lost})"


def claims(cmp: Mapping[str, Endurance], page: Page) -> None:
    """Compare the paper's limits with ours, by sweep."""
    light, noise = cmp["light"].bears, cmp["salt_and_pepper"].bears
    met = {
        "light": light is not None and light <= 0.4,
        "contrast": None,
        "salt_and_pepper": noise is not None and noise >= 0.05,
    }
    for key, verdict in met.items():
        page.claim(f"reliability.{key}", verdict, range=_range(key, cmp))


def _range(key: str, cmp: Mapping[str, Endurance]) -> str:
    sweep, endurance = SWEEPS[key], cmp[key]
    first = endurance.fails_at
    if endurance.bears is None:
        return "fails without it"
    if first is None:
        return f"works to {sweep.text(endurance.bears)}, the last level tried"
    return (
        f"works to {sweep.text(endurance.bears)}; begins to fail at "
        f"{sweep.text(endurance.levels[first])} ({100 * endurance.found[first]:.3g} % of the "
        "markers found there)"
    )


def _curves(endurances: Endurances) -> Figure:
    """Success and markers found over the levels of all sweeps, of every method."""
    figure, axes = panels(2, len(SWEEPS), 4.6, sharex="col", sharey=True)
    for column, (key, sweep) in zip(axes.T, SWEEPS.items(), strict=True):
        for number, method in enumerate(ALL_METHODS):
            endurance = endurances[key, method.key]
            # One on the other, all are to be seen.
            style = {**look(method.key, hollow=True), "markersize": 9.0 - 1.4 * number}
            for axis, values in zip(column, (endurance.success, endurance.found), strict=True):
                axis.plot(endurance.levels, 100 * values, label=method.label, **style)
                if sweep.paper_limit is not None:
                    axis.axvline(sweep.paper_limit, color=PAPER_COLOUR, linestyle="--")
        column[0].set_title(sweep.title)
        column[1].set_xlabel(sweep.level)
        if sweep.levels[0] > sweep.levels[-1]:
            column[1].set_xscale("log")
            column[1].minorticks_off()
            column[1].invert_xaxis()
    axes[0, 0].set_ylabel("frames without fault, %")
    axes[1, 0].set_ylabel("markers found, %")
    legend(figure, axes[0, 0], 3)
    return figure
