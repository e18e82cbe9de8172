"""V.D: the grasp of a hexagonal wrench with a knock, and knocks of any size; the cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import Grid
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_simulation.rendering.surface import DeformedSurface
from cmp_tactile_simulation.scenes.description import Hold, MoveBy, Phase, Scene
from cmp_tactile_simulation.scenes.file import load_scene
from paper.chain import Chain, Measurement, Method, score_markers
from paper.dot_tracking import FOLLOWING_METHODS
from paper.experiment import Case, Workplace
from paper.gel import Mechanics, build_force_model, mechanics_of
from paper.sequence import PrintedGel, Truth

# The quick run's phases last so many frames where the scene's last longer.
FAST_FRAMES = {"rest": 2, "close": 6, "hold": 3, "open": 6, "rest again": 2}
FAST_NODES = 28
# Of the bar from the middle to either end of the stroke, m: the gel under it moves 1.5 pitches.
HALF_STROKE = 0.00115
PRESS = 0.0011
STROKE_FRAMES = 60


@dataclass(frozen=True)
class Direction:
    """In which the bar moves, (x, y) of length 1 in the gel frame."""

    name: str
    x: float
    y: float


DIRECTIONS = (
    Direction("along", 1.0, 0.0),
    Direction("across", 0.0, 1.0),
    Direction("diagonal", 0.5**0.5, 0.5**0.5),
)


def sensor() -> SensorDescription:
    """That of the paper's section V.  Its gel is that of the scene's sensor."""
    return load_sensor("prototype")


def grasp_scene(place: Workplace) -> Scene:
    """The packaged scene on the prototype; the quick run has fewer frames of what is slow."""
    scene = replace(load_scene("grasp"), sensor=sensor())
    if not place.fast:
        return scene
    motion = tuple(
        replace(phase, frames=min(phase.frames, FAST_FRAMES.get(phase.name, phase.frames)))
        for phase in scene.motion
    )
    return replace(scene, motion=motion, contact_nodes=FAST_NODES)


def stroke_scene(place: Workplace, direction: Direction) -> Scene:
    """The same bar, pressed in and pushed slowly from one side to the other."""
    out = -HALF_STROKE * direction.x, -HALF_STROKE * direction.y, 0.0
    back = -2 * out[0], -2 * out[1], 0.0
    scene = grasp_scene(place)
    motion = (
        Phase("rest", 1, Hold()),
        Phase("close", 7, MoveBy((0.0, 0.0, -PRESS))),
        Phase("drag", 5, MoveBy(out)),
        Phase("stroke", STROKE_FRAMES, MoveBy(back), "linear"),
    )
    return replace(scene, name=f"stroke_{direction.name}", motion=motion)


# Markers move by so many pitches from frame to frame on the way to where a knock begins.
SLOW = 0.2


@dataclass(frozen=True)
class StrokePath:
    """Frames of a stroke by how far the gel has gone.

    close: frames that press the bar in, before it is anywhere aside.  frames: of the stroke.
    travel: pitches that the marker which moves furthest has gone in each of these from the
    stroke's middle, negative before it.
    """

    close: tuple[int, ...]
    frames: NDArray[np.intp]
    travel: NDArray[np.float64]

    @classmethod
    def from_mechanics(cls, mechanics: Mechanics, pitch: float) -> StrokePath:
        """Of a scene with the phases close and stroke."""
        frames = mechanics.frames("stroke")
        moved = mechanics.displacement[frames] - mechanics.displacement[frames[0]]
        travel = np.linalg.norm(moved, axis=-1).max(axis=(1, 2)) / pitch
        close = tuple(mechanics.frames("rest", "close").tolist())[::2]
        return cls(close, frames, travel - travel[-1] / 2)

    def to_start(self, start: float) -> list[int]:
        """Frames from the gel at rest to where the bar has gone `start` pitches aside."""
        steps = max(int(np.ceil(abs(start) / SLOW)), 1)
        return [*self.close, *(self._nearest(start * k / steps) for k in range(steps + 1))]

    def knock(self, size: float, sign: int) -> list[int]:
        """The frames before and after a knock by `size` pitches across the middle.

        sign: 1 forwards, -1 backwards.
        """
        return [self._nearest(sign * size * share) for share in (-0.5, 0.5)]

    def _nearest(self, travel: float) -> int:
        return int(self.frames[np.argmin(np.abs(self.travel - travel))])


# Of each knock: largest true step of a marker, pitches; shares of the visible markers with wrong
# numbers in the frame before, in its frame, and in the next, where all stands still; shares found
# in its frame and the next; errors of the force in these two, shares of the stroke's largest force.
COLUMNS = ("jump", "before", "wrong", "after", "found", "found_after", "force", "force_after")
REFERENCE_IMAGES = 4


@dataclass(frozen=True)
class _Shot:
    frame: int
    image: NDArray[np.uint8]
    truth: Truth
    force: NDArray[np.float64]


class _Stroke:
    """A slow stroke, of which frames are rendered when they are first asked for."""

    def __init__(self, place: Workplace, direction: Direction, pattern_type: str) -> None:
        scene = stroke_scene(place, direction)
        self.sensor = scene.sensor
        self._mechanics = mechanics_of(scene, place)
        build_force_model(scene.sensor, place)
        self._gel = PrintedGel(scene.sensor, pattern_type)
        self.path = StrokePath.from_mechanics(self._mechanics, scene.sensor.pattern.pitch)
        self._shots: dict[int, _Shot] = {}
        self.methods = [m for m in FOLLOWING_METHODS if m.pattern_type == pattern_type]

    @cached_property
    def peak(self) -> float:
        """The largest force of the stroke, N."""
        return float(np.linalg.norm(self._mechanics.wrench[:, :3], axis=1).max())

    def at_rest(self) -> list[NDArray[np.uint8]]:
        """Images for the reference."""
        rendered = self._gel.rendered(self._surface(0))
        return [self._gel.exposed(rendered, 10_000 + k) for k in range(REFERENCE_IMAGES)]

    def shot(self, frame: int) -> _Shot:
        """A frame, sharp."""
        if frame not in self._shots:
            surface = self._surface(frame)
            image = self._gel.image(surface, frame)
            self._shots[frame] = self._with_truth(image, frame)
        return self._shots[frame]

    def _with_truth(self, image: NDArray[np.uint8], frame: int) -> _Shot:
        truth = self._gel.truth(self._surface(frame))
        return _Shot(frame, image, truth, self._mechanics.wrench[frame, :3])

    def _surface(self, frame: int) -> DeformedSurface:
        return self._mechanics.surface(frame, self.sensor.pattern)


Follow = Callable[[Chain], list[float]]


def knocks(
    place: Workplace, pattern_type: str, direction: Direction, sizes: tuple[float, ...]
) -> dict[str, Any]:
    """Each size (pitches) forwards and backwards: "<key>" (sizes, 2, COLUMNS) of each method."""
    stroke = _Stroke(place, direction, pattern_type)

    def one(size: float, sign: int) -> Follow:
        way = stroke.path.knock(size, sign)
        approach = stroke.path.to_start(-sign * size / 2)
        return lambda chain: _followed(chain, stroke, approach, stroke.shot(way[-1]))

    return _of_each(stroke, [[one(size, sign) for sign in (1, -1)] for size in sizes])


def _of_each(stroke: _Stroke, follows: Sequence[Sequence[Follow]]) -> dict[str, Any]:
    result = {}
    for method in stroke.methods:
        chain = Chain(stroke.sensor, method, with_force=True)
        chain.set_reference(stroke.at_rest())
        result[method.key] = np.array([[follow(chain) for follow in row] for row in follows])
    return result


def _followed(chain: Chain, stroke: _Stroke, approach: Sequence[int], after: _Shot) -> list[float]:
    """COLUMNS of a knock: its frame, then the same place once more."""
    chain.reset()
    for frame in approach[:-1]:
        chain.measure(stroke.shot(frame).image)
    before = stroke.shot(approach[-1])
    calm = _judged(chain, before, stroke.peak)
    during = _judged(chain, after, stroke.peak)
    later = _judged(chain, after, stroke.peak)
    jump = _step(before.truth, after.truth) / stroke.sensor.pattern.pitch
    return [jump, calm[0], during[0], later[0], during[1], later[1], during[2], later[2]]


def _judged(chain: Chain, shot: _Shot, peak: float) -> tuple[float, float, float]:
    """Shares of the visible markers wrong and found; error of the force, NaN without one."""
    measured = chain.measure(shot.image)
    score = score_markers(measured.grids, shot.truth.grids)
    error = float("nan")
    if measured.force is not None:
        error = float(np.linalg.norm(measured.force.wrench[:3] - shot.force)) / peak
    return score.wrong / score.visible, score.found / score.visible, error


def _step(before: Truth, after: Truth) -> float:
    """How far the marker that moves furthest moves, m."""
    step = after.surface.position - before.surface.position
    return float(np.linalg.norm(step, axis=-1).max())


# Noise of the frames of the reference, so that no measured frame is its own reference.
REFERENCE_NUMBER = 10_000
NUMBERS_OF_A_COURSE = 100_000
VIEW = "left"


@dataclass(frozen=True)
class _Course:
    """One rendered sequence of the grasp: frames and truth; `knock` is the frame of the knock."""

    rest: Sequence[NDArray[np.uint8]]
    images: Sequence[NDArray[np.uint8]]
    truth: Sequence[Truth]
    knock: int


def measure_grasp(place: Workplace, pattern_type: str, seeds: int) -> dict[str, Any]:
    """What all methods of a print (cmp or dmp) measure, over so many draws of the noise.

    F frames, S seeds; K the knock's frame.  phase, true_wrench (F, 6): N, N m.  Of each method, by
    "<key>.": wrench (S, F, 6), NaN where it gives none; wrong, found (S, F): shares of the visible
    markers; flags (S, F); of the first seed at K nodes (M, 3) m, node_force (M, 3) N, and corners
    of the left view before (K - 1) and after (K), px.  true_*: the same of the truth.
    crop: the left view at K.
    """
    scene = grasp_scene(place)
    mechanics = mechanics_of(scene, place)
    build_force_model(scene.sensor, place)
    courses = _courses(mechanics, PrintedGel(scene.sensor, pattern_type), seeds)
    result = _truth_of(mechanics, courses[0])
    for method in FOLLOWING_METHODS:
        if method.pattern_type == pattern_type:
            result |= {f"{method.key}.{k}": v for k, v in _measured(method, courses).items()}
    return result


def _courses(mechanics: Mechanics, gel: PrintedGel, seeds: int) -> list[_Course]:
    """One for each draw of the noise."""
    truth: list[Truth] = []
    rest: list[list[NDArray[np.uint8]]] = [[] for _ in range(seeds)]
    images: list[list[NDArray[np.uint8]]] = [[] for _ in range(seeds)]
    at_rest = set(mechanics.frames("rest").tolist())
    for f in range(len(mechanics)):
        surface = mechanics.surface(f, gel.sensor.pattern)
        truth.append(gel.truth(surface))
        rendered = gel.rendered(surface)
        for seed in range(seeds):
            number = f + seed * NUMBERS_OF_A_COURSE
            images[seed].append(gel.exposed(rendered, number))
            if f in at_rest:
                rest[seed].append(gel.exposed(rendered, number + REFERENCE_NUMBER))
    knock = int(mechanics.frames("knock")[0])
    return [_Course(*course, truth, knock) for course in zip(rest, images, strict=True)]


def _truth_of(mechanics: Mechanics, course: _Course) -> dict[str, Any]:
    knock, grids = (
        course.knock,
        [course.truth[f].grids[VIEW] for f in (course.knock - 1, course.knock)],
    )
    return {
        "phase": mechanics.phase,
        "rate": mechanics.rate,
        "knock": knock,
        "pitch": sensor().pattern.pitch,
        "jump": _jump(course.truth[knock - 1], course.truth[knock]) / sensor().pattern.pitch,
        "true_wrench": mechanics.wrench,
        "true_nodes": mechanics.node_position,
        "true_node_force": mechanics.force[knock],
        "true_before": grids[0].corners,
        "true_after": grids[1].corners,
        "crop": _view(course.images[knock], grids[1]),
    }


def _jump(before: Truth, after: Truth) -> float:
    """How far the marker that moves furthest moves, m."""
    step = after.surface.position - before.surface.position
    return float(np.linalg.norm(step, axis=-1).max())


def _view(image: NDArray[np.uint8], grid: Grid) -> NDArray[np.uint8]:
    place = grid.placement
    if place is None:
        msg = "the truth does not say where its view lies"
        raise ValueError(msg)
    view = image[place.y : place.y + place.height, place.x : place.x + place.width]
    return np.ascontiguousarray(view[:, ::-1] if place.flipped else view)


def _measured(method: Method, courses: Sequence[_Course]) -> dict[str, Any]:
    chain = Chain(sensor(), method, with_force=True)
    rows: dict[str, list[list[Any]]] = {"wrench": [], "wrong": [], "found": [], "flags": []}
    picture: dict[str, Any] = {}
    for course in courses:
        chain.reset()
        chain.set_reference(course.rest)
        chain.reset()
        for column in rows.values():
            column.append([])
        for f, image in enumerate(course.images):
            measured = chain.measure(image)
            for name, value in _numbers(measured, course.truth[f]).items():
                rows[name][-1].append(value)
            if course is courses[0] and f in (course.knock - 1, course.knock):
                picture |= _pictured(measured, "after" if f == course.knock else "before")
    return {name: np.array(column) for name, column in rows.items()} | picture


def _numbers(measured: Measurement, truth: Truth) -> dict[str, Any]:
    if measured.force is None:
        msg = "the chain was made without force"
        raise ValueError(msg)
    score = score_markers(measured.grids, truth.grids)
    return {
        "wrench": measured.force.wrench,
        "wrong": score.wrong / score.visible,
        "found": score.found / score.visible,
        "flags": int(measured.force.flags),
    }


def _pictured(measured: Measurement, when: str) -> dict[str, Any]:
    found: dict[str, Any] = {when: measured.grids[VIEW].corners}
    if when == "after" and measured.force is not None:
        found |= {"nodes": measured.force.position, "node_force": measured.force.force}
    return found


PRINTS = ("cmp", "dmp")
SEEDS = 3
# Pitches from one frame to the next.
SIZES = (0.2, 0.4, 0.45, 0.5, 0.55, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)
FAST_SIZES = (0.4, 0.8, 2.0)


def cases(place: Workplace) -> list[Case]:
    """The grasp and the knocks, each once for a print; the quick run has one direction."""
    seeds = 1 if place.fast else SEEDS
    found = [
        Case(f"grasp-{p}", measure_grasp, (p, seeds), 20 if place.fast else 60) for p in PRINTS
    ]
    if place.fast:
        along = DIRECTIONS[0]
        quick = [
            Case(f"knock-{along.name}-{p}", knocks, (p, along, FAST_SIZES), 12) for p in PRINTS
        ]
        return found + quick
    for p in PRINTS:
        found += [Case(f"knock-{d.name}-{p}", knocks, (p, d, SIZES), 50) for d in DIRECTIONS]
    return found
