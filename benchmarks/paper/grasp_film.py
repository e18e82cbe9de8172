"""The whole grasp, filmed with one print and measured by every method that reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.grid import Grid
from paper.built_once import build_force_model
from paper.chain import Chain, Measurement
from paper.dot_methods import FOLLOWING_METHODS
from paper.experiment import Workplace
from paper.film import Film, Truth
from paper.grasp_scene import grasp_scene, sensor
from paper.mechanics import Mechanics, mechanics_of
from paper.method import Method
from paper.scoring import score_markers

__all__ = ["film_grasp"]

# Noise of the frames of the reference, so that no measured frame is its own reference.
REFERENCE_NUMBER = 10_000
NUMBERS_OF_A_TAKE = 100_000
VIEW = "left"


@dataclass(frozen=True)
class _Take:
    """One film of the grasp: frames and truth; `knock` is the frame of the knock."""

    rest: Sequence[NDArray[np.uint8]]
    images: Sequence[NDArray[np.uint8]]
    truth: Sequence[Truth]
    knock: int


def film_grasp(place: Workplace, pattern_type: str, seeds: int) -> dict[str, Any]:
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
    takes = _takes(mechanics, Film(scene.sensor, pattern_type), seeds)
    result = _truth_of(mechanics, takes[0])
    for method in FOLLOWING_METHODS:
        if method.pattern_type == pattern_type:
            result |= {f"{method.key}.{k}": v for k, v in _measured(method, takes).items()}
    return result


def _takes(mechanics: Mechanics, film: Film, seeds: int) -> list[_Take]:
    """One for each draw of the noise."""
    truth: list[Truth] = []
    rest: list[list[NDArray[np.uint8]]] = [[] for _ in range(seeds)]
    images: list[list[NDArray[np.uint8]]] = [[] for _ in range(seeds)]
    at_rest = set(mechanics.frames("rest").tolist())
    for f in range(len(mechanics)):
        surface = mechanics.surface(f, film.sensor.pattern)
        truth.append(film.truth(surface))
        rendered = film.rendered(surface)
        for seed in range(seeds):
            number = f + seed * NUMBERS_OF_A_TAKE
            images[seed].append(film.exposed(rendered, number))
            if f in at_rest:
                rest[seed].append(film.exposed(rendered, number + REFERENCE_NUMBER))
    knock = int(mechanics.frames("knock")[0])
    return [_Take(*take, truth, knock) for take in zip(rest, images, strict=True)]


def _truth_of(mechanics: Mechanics, take: _Take) -> dict[str, Any]:
    knock, grids = take.knock, [take.truth[f].grids[VIEW] for f in (take.knock - 1, take.knock)]
    return {
        "phase": mechanics.phase,
        "rate": mechanics.rate,
        "knock": knock,
        "pitch": sensor().pattern.pitch,
        "jump": _jump(take.truth[knock - 1], take.truth[knock]) / sensor().pattern.pitch,
        "true_wrench": mechanics.wrench,
        "true_nodes": mechanics.node_position,
        "true_node_force": mechanics.force[knock],
        "true_before": grids[0].corners,
        "true_after": grids[1].corners,
        "crop": _view(take.images[knock], grids[1]),
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


def _measured(method: Method, takes: Sequence[_Take]) -> dict[str, Any]:
    chain = Chain(sensor(), method, with_force=True)
    rows: dict[str, list[list[Any]]] = {"wrench": [], "wrong": [], "found": [], "flags": []}
    picture: dict[str, Any] = {}
    for take in takes:
        chain.reset()
        chain.set_reference(take.rest)
        chain.reset()
        for column in rows.values():
            column.append([])
        for f, image in enumerate(take.images):
            measured = chain.measure(image)
            for name, value in _numbers(measured, take.truth[f]).items():
                rows[name][-1].append(value)
            if take is takes[0] and f in (take.knock - 1, take.knock):
                picture |= _pictured(measured, "after" if f == take.knock else "before")
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
