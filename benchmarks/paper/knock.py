"""At which jump of the markers from one frame to the next does a method begin to fail?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.rendering.surface import DeformedSurface
from paper.built_once import build_force_model
from paper.chain import Chain
from paper.dot_methods import FOLLOWING_METHODS
from paper.experiment import Workplace
from paper.film import Film, Truth
from paper.grasp_scene import Direction, stroke_scene
from paper.knock_path import StrokePath
from paper.mechanics import mechanics_of
from paper.scoring import score_markers

__all__ = ["COLUMNS", "knocks"]

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
    """A slow stroke, of which frames are filmed when they are first asked for."""

    def __init__(self, place: Workplace, direction: Direction, pattern_type: str) -> None:
        scene = stroke_scene(place, direction)
        self.sensor = scene.sensor
        self._mechanics = mechanics_of(scene, place)
        build_force_model(scene.sensor, place)
        self._film = Film(scene.sensor, pattern_type)
        self.path = StrokePath.from_mechanics(self._mechanics, scene.sensor.pattern.pitch)
        self._shots: dict[int, _Shot] = {}
        self.methods = [m for m in FOLLOWING_METHODS if m.pattern_type == pattern_type]

    @cached_property
    def peak(self) -> float:
        """The largest force of the stroke, N."""
        return float(np.linalg.norm(self._mechanics.wrench[:, :3], axis=1).max())

    def at_rest(self) -> list[NDArray[np.uint8]]:
        """Images for the reference."""
        rendered = self._film.rendered(self._surface(0))
        return [self._film.exposed(rendered, 10_000 + k) for k in range(REFERENCE_IMAGES)]

    def shot(self, frame: int) -> _Shot:
        """A frame, sharp."""
        if frame not in self._shots:
            surface = self._surface(frame)
            image = self._film.image(surface, frame)
            self._shots[frame] = self._with_truth(image, frame)
        return self._shots[frame]

    def _with_truth(self, image: NDArray[np.uint8], frame: int) -> _Shot:
        truth = self._film.truth(self._surface(frame))
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
