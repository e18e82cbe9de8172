#!/usr/bin/env python3
"""Coded patterns: corners that the dots number, wrong numbers, and the cost of the dots.

`pieces` are parts of a sheet with misread dots. The other parts use rendered frames with exact
truth: covers of up to 80 % of the pattern, slides of any size, all kinds of hard frames, and the
errors of corners and virtual markers with and without dots, by the size of the checkers. All parts
take some ten minutes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import process_time

sys.path.insert(0, str(Path(__file__).parents[1]))
import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.printing.advice import checker_sides_px
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.dot_code import dot_map
from cmp_tactile_processing.sensor.parts import FEWEST_CODED
from cmp_tactile_processing.tracking.dots.decoder import DotDecoder
from cmp_tactile_processing.tracking.tracker import GridTracker
from hard_frames.covers import COVERS, Cover, far_corners
from hard_frames.deformation import deformation_of
from hard_frames.grid_score import GridScore, join_scores, score_grid
from hard_frames.library import CASE_KINDS, cases_of
from hard_frames.studio import PatternCase, PatternFrame, PatternStudio, pattern_rig

SHARES = (0.2, 0.4, 0.6, 0.8)
# In checkers, to the right and down.
SLIDES = ((2, 0), (0, -3), (-5, 5), (8, 0), (0, 11), (-14, 3))
PIECES = ((5, 5), (6, 6), (6, 7), (7, 7), (8, 8))
MISREAD = (0.0, 0.05, 0.1)
# Corners along a side of patterns of one size.
SIDES = (12, 16, 20, 26, 30, 40)
BEHIND = 120


def coded(sensor: SensorDescription, code: str = "dots") -> SensorDescription:
    """The sensor with a pattern that has a code, where it is large enough for one."""
    pattern = sensor.pattern
    small = (pattern.rows + 1) * (pattern.cols + 1) < FEWEST_CODED
    return replace(sensor, pattern=replace(pattern, code="none" if small else code))


class Views:
    """Tracks the views of frames, each by itself; keeps trackers."""

    def __init__(self) -> None:
        self._trackers: dict[int, tuple[SensorDescription, dict[str, GridTracker]]] = {}
        self.seconds: list[float] = []

    def score(self, frame: PatternFrame, moved: tuple[float, float] = (0.0, 0.0)) -> GridScore:
        """Of both views together; moved: by how much the image is shifted, px."""
        return join_scores(self._one(frame, view, moved) for view in frame.truth)

    def _one(self, frame: PatternFrame, view: str, moved: tuple[float, float]) -> GridScore:
        truth, place = frame.truth[view], frame.truth[view].placement
        image = frame.image[place.y : place.y + place.height, place.x : place.x + place.width]
        image = np.ascontiguousarray(image[:, ::-1] if place.flipped else image)
        far, visible = frame.far[view], frame.visible[view]
        if any(moved):
            image, truth, inside = _shifted(image, truth, moved)
            visible = visible & inside
            around = np.ones((image.shape[0] + 2, image.shape[1] + 2), bool)
            around[1:-1, 1:-1] = False
            held = np.clip(truth.corners, 0, np.array(image.shape[::-1]) - 1)
            far = far & visible & far_corners(held + 1, around)
        tracker = self._tracker(frame.sensor, view)
        tracker.reset()
        began = process_time()
        grid = tracker.track(image)
        self.seconds.append(process_time() - began)
        return score_grid(grid, truth, visible, far)

    def _tracker(self, sensor: SensorDescription, view: str) -> GridTracker:
        known = self._trackers.setdefault(id(sensor), (sensor, {}))[1]
        if view not in known:
            known[view] = GridTracker(sensor, view)
        return known[view]


def _shifted(image, truth, moved):  # noqa: ANN001, ANN202 - three of a kind in, three out
    """The image shifted by px, the truth with it, and which corners are still in it."""
    shift = np.array([[1.0, 0.0, moved[0]], [0.0, 1.0, moved[1]]])
    size = image.shape[1], image.shape[0]
    image = cv2.warpAffine(image, shift, size, flags=cv2.INTER_NEAREST, borderValue=BEHIND)
    corners = truth.corners + moved
    inside = ((corners >= 0) & (corners <= np.array(size) - 1)).all(axis=-1)
    lines = [np.full_like(points, np.nan) for points in (truth.row_lines, truth.col_lines)]
    return image, replace(truth, corners=corners, row_lines=lines[0], col_lines=lines[1]), inside


def row(name: str, score: GridScore) -> None:
    """One line of the tables of frames."""
    print(
        f"{name:30s} | {score.grids:5d} | {score.found_far:6d} of {score.far:6d} | "
        f"{score.found_visible:6d} of {score.visible:6d} | {score.wrong:5d}",
        flush=True,
    )


def head(title: str) -> None:
    """The first line of such a table; far: two checkers from what hides or cuts off the rest."""
    print(f"\n{title:30s} | views | far corners numbered | visible corners numbered | wrong")


def pieces() -> None:
    """Pieces of sheets with misread dots: how many are certain of their place, and wrong."""
    print("\npieces of the sheet, by misread dots: share with numbers (wrong numbers of 500)")
    for size in (21, 42, 61):
        sheet, rng = dot_map(size, size), np.random.default_rng(size)
        decoder = DotDecoder(sheet, dark_first=True)
        for shape in PIECES:
            found = [_placed(decoder, sheet, shape, share, rng) for share in MISREAD]
            text = ", ".join(
                f"{share:.0%}: {right / 500:4.0%} ({wrong})"
                for share, (right, wrong) in zip(MISREAD, found, strict=True)
            )
            print(
                f"sheet of {size} x {size}, {shape[0]} x {shape[1]} checkers | {text}", flush=True
            )


def _placed(
    decoder: DotDecoder,
    sheet: NDArray[np.bool_],
    shape: tuple[int, int],
    share: float,
    rng: np.random.Generator,
) -> tuple[int, int]:
    right = wrong = 0
    for _ in range(500):
        i, j = rng.integers(0, np.array(sheet.shape) - shape + 1)
        bits = np.where(sheet[i : i + shape[0], j : j + shape[1]], 1, -1).ravel()
        bits[rng.permutation(bits.size)[: round(share * bits.size)]] *= -1
        found = decoder.decode(bits.reshape(shape).astype(np.int8), (i + j) % 2 == 0)
        if found is not None and found.is_certain:
            correct = (found.shift == (i, j)).all() and not (found.turns or found.mirrored)
            right, wrong = right + correct, wrong + (not correct)
    return right, wrong


def occlusions(studio: PatternStudio, views: Views, sensor: SensorDescription) -> None:
    """Covers of all shapes and shares."""
    head("hidden share of the pattern")
    for share in SHARES:
        scores = []
        for number, shape in enumerate(COVERS):
            for kind in ("rest", "slide"):
                cover = Cover(shape, share, (15.0, 110.0, 200.0)[number % 3])
                zones = deformation_of(kind, sensor.pattern, number)
                case = PatternCase("hidden", sensor, zones, cover=cover, seed=number)
                scores.append(views.score(studio.photograph(case)))
        row(f"{share:.0%}", join_scores(scores))


def slides(studio: PatternStudio, views: Views, sensor: SensorDescription) -> None:
    """Images that are shifted by whole checkers and parts of one, border out of view or not."""
    head("slide, checkers")
    side = float(np.median(np.concatenate(list(checker_sides_px(sensor).values()))))
    for slide in SLIDES:
        scores = []
        for kind in ("rest", "twist"):
            frame = studio.photograph(
                PatternCase("slid", sensor, deformation_of(kind, sensor.pattern))
            )
            for part in (0.0, 0.4):
                moved = tuple(float(round((value + part) * side)) for value in slide)
                scores.append(views.score(frame, moved))
        row(f"{slide[0]}, {slide[1]}", join_scores(scores))


def hard(studio: PatternStudio, views: Views, sensor: SensorDescription) -> None:
    """All kinds of hard frames of the extraction benchmark."""
    head("hard frames")
    for kind in CASE_KINDS:
        scores = []
        for case in cases_of(kind, sensor):
            try:
                found = views.score(studio.photograph(replace(case, sensor=coded(case.sensor))))
            except GeometryError as error:
                print(f"{case.name}: {error}")
                continue
            scores.append(found)
        row(kind, join_scores(scores))


def exactness(studio: PatternStudio, views: Views, sensor: SensorDescription) -> None:  # noqa: ARG001
    """Corners and virtual markers with and without dots, by the size of checkers."""
    print("\nsmallest checker, px | corner rms px, without and with dots | virtual marker rms px")
    for count in SIDES:
        rig = pattern_rig(count, count)
        side = min(float(values.min()) for values in checker_sides_px(rig).values())
        found = []
        for code in ("none", "dots"):
            made = coded(rig, code)
            cases = [
                PatternCase(kind, made, deformation_of(kind, made.pattern, seed), seed=seed)
                for kind in ("rest", "press", "slide", "twist", "knock")
                for seed in range(2)
            ]
            found.append(join_scores(views.score(studio.photograph(case)) for case in cases))
        plain, dotted = found
        print(
            f"{side:20.1f} | {plain.corner_rmse:.4f}, {dotted.corner_rmse:.4f} "
            f"({dotted.corner_rmse / plain.corner_rmse - 1:+.1%}) | "
            f"{plain.virtual_rms:.4f}, {dotted.virtual_rms:.4f} "
            f"({dotted.virtual_rms / plain.virtual_rms - 1:+.1%})",
            flush=True,
        )


def speed(studio: PatternStudio, views: Views, sensor: SensorDescription) -> None:
    """Processor time of detecting a view with and without dots, in turns."""
    seconds: dict[str, list[float]] = {"none": [], "dots": []}
    frames = {
        code: studio.photograph(PatternCase("at rest", coded(sensor, code))) for code in seconds
    }
    for _ in range(40):
        for code, frame in frames.items():
            views.seconds.clear()
            views.score(frame)
            seconds[code] += views.seconds
    found = {code: 1e3 * float(np.median(values)) for code, values in seconds.items()}
    print(f"\ndetecting a view: {found['none']:.1f} ms without dots, {found['dots']:.1f} ms with")


PARTS: dict[str, Callable[[PatternStudio, Views, SensorDescription], None]] = {
    "occlusions": occlusions,
    "slides": slides,
    "hard": hard,
    "exactness": exactness,
    "speed": speed,
}


def chosen_parts(names: list[str]) -> Iterator[str]:
    """The parts to run, in order."""
    return (name for name in ("pieces", *PARTS) if not names or name in names)


def main() -> int:
    """Measure the parts that are asked for."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument(
        "parts", nargs="*", metavar="PART", help=f"run only these: pieces, {', '.join(PARTS)}"
    )
    asked = given.parse_args().parts
    if unknown := set(asked) - {"pieces", *PARTS}:
        given.error(f"found {', '.join(sorted(unknown))}, expected pieces, {', '.join(PARTS)}")
    cv2.setNumThreads(1)
    studio, views, sensor = PatternStudio(), Views(), coded(load_sensor("sample_rig"))
    for name in chosen_parts(asked):
        if name == "pieces":
            pieces()
        else:
            PARTS[name](studio, views, sensor)
    return 0


if __name__ == "__main__":
    sys.exit(main())
