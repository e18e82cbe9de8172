#!/usr/bin/env python3
"""Coded patterns: corners that the dots number, wrong numbers, and the cost of the dots.

`pieces` are parts of a sheet with misread dots. The other parts use rendered frames with exact
truth: covers of up to 80 % of the pattern, slides of any size, all kinds of hard frames, and the
errors of corners and virtual markers with and without dots, by the size of the checkers. All parts
take some ten minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
import cv2
import numpy as np
from detectors import Ours, run_frames
from numpy.typing import NDArray
from tables import CommandLine, head, line

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.printing.pattern import checker_sides_px
from cmp_tactile_processing.sensor.description import SensorDescription, load_sensor
from cmp_tactile_processing.sensor.dot_code import dot_map
from cmp_tactile_processing.sensor.parts import FEWEST_CODED
from cmp_tactile_processing.tracking.dots import DotDecoder
from hard_frames.covers import COVERS, Cover, far_from_edge
from hard_frames.grid_score import GridScore, join_scores
from hard_frames.library import CASE_KINDS, COVER_GREYS, cases_of
from hard_frames.studio import PatternFrame, PatternStudio, bent, pattern_rig

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


def shifted(frame: PatternFrame, moved: tuple[float, float]) -> PatternFrame:
    """Each view shifted by whole px within its part of the frame; what comes in is grey.

    Virtual markers are not known then.
    """
    image, truth, visible, far = frame.image.copy(), {}, {}, {}
    for view, grid in frame.truth.items():
        place = grid.placement
        part = image[place.y : place.y + place.height, place.x : place.x + place.width]
        size = place.width, place.height
        way = np.array([[1.0, 0.0, -moved[0] if place.flipped else moved[0]], [0.0, 1.0, moved[1]]])
        part[:] = cv2.warpAffine(part, way, size, flags=cv2.INTER_NEAREST, borderValue=BEHIND)
        corners = grid.corners + moved
        lines = {
            name: np.full_like(getattr(grid, name), np.nan) for name in ("row_lines", "col_lines")
        }
        truth[view] = replace(grid, corners=corners, **lines)
        inside = ((corners >= 0) & (corners <= np.array(size) - 1)).all(axis=-1)
        visible[view] = frame.visible[view] & inside
        far[view] = frame.far[view] & visible[view] & far_from_edge(corners, size[::-1])
    return replace(frame, image=image, truth=truth, visible=visible, far=far)


def row(name: str, score: GridScore) -> None:
    """A line of the tables of frames."""
    far = f"{score.found_far} of {score.far}"
    visible = f"{score.found_visible} of {score.visible}"
    print(line(name, score.grids, far, visible, score.wrong), flush=True)


def title(text: str) -> None:
    """The head of such a table; far: two checkers from what hides or cuts off the rest."""
    print(f"\n{head(text, 'views', 'far corners numbered', 'visible corners numbered', 'wrong')}")


def pieces(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:  # noqa: ARG001
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


def occlusions(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:
    """Covers of all shapes and shares."""
    title("hidden share of the pattern")
    for share in SHARES:
        frames = [
            studio.photograph(
                bent(sensor, kind, number, cover=Cover(shape, share, COVER_GREYS[number % 3]))
            )
            for number, shape in enumerate(COVERS)
            for kind in ("rest", "slide")
        ]
        row(f"{share:.0%}", run_frames(tracker, frames).score)


def slides(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:
    """Images that are shifted by whole checkers and parts of one, border out of view or not."""
    title("slide, checkers")
    side = float(np.median(np.concatenate(list(checker_sides_px(sensor).values()))))
    still = [studio.photograph(bent(sensor, kind)) for kind in ("rest", "twist")]
    for slide in SLIDES:
        frames = [
            shifted(frame, tuple(float(round((value + part) * side)) for value in slide))
            for frame in still
            for part in (0.0, 0.4)
        ]
        row(f"{slide[0]}, {slide[1]}", run_frames(tracker, frames).score)


def hard(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:
    """All kinds of hard frames of the extraction benchmark."""
    title("hard frames")
    for kind in CASE_KINDS:
        scores = []
        for case in cases_of(kind, sensor):
            try:
                frame = studio.photograph(replace(case, sensor=coded(case.sensor)))
            except InputError as error:
                print(f"{case.name}: {error}")
                continue
            scores.append(run_frames(tracker, [frame]).score)
        row(kind, join_scores(scores))


def exactness(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:  # noqa: ARG001
    """Corners and virtual markers with and without dots, by the size of checkers."""
    print("\nsmallest checker, px | corner rms px, without and with dots | virtual marker rms px")
    for count in SIDES:
        rig = pattern_rig(count, count)
        side = min(float(values.min()) for values in checker_sides_px(rig).values())
        found = []
        for code in ("none", "dots"):
            made = coded(rig, code)
            frames = [
                studio.photograph(bent(made, kind, seed))
                for kind in ("rest", "press", "slide", "twist", "knock")
                for seed in range(2)
            ]
            found.append(run_frames(tracker, frames).score)
        plain, dotted = found
        print(
            f"{side:20.1f} | {plain.corner_rmse:.4f}, {dotted.corner_rmse:.4f} "
            f"({dotted.corner_rmse / plain.corner_rmse - 1:+.1%}) | "
            f"{plain.virtual_rms:.4f}, {dotted.virtual_rms:.4f} "
            f"({dotted.virtual_rms / plain.virtual_rms - 1:+.1%})",
            flush=True,
        )


def speed(studio: PatternStudio, tracker: Ours, sensor: SensorDescription) -> None:
    """Processor time of detecting a view with and without dots, in turns."""
    frames = {
        code: studio.photograph(bent(coded(sensor, code), "rest")) for code in ("none", "dots")
    }
    seconds: dict[str, list[float]] = {code: [] for code in frames}
    for _ in range(40):
        for code, frame in frames.items():
            seconds[code] += run_frames(tracker, [frame]).seconds
    found = {code: 1e3 * float(np.median(values)) for code, values in seconds.items()}
    print(f"\ndetecting a view: {found['none']:.1f} ms without dots, {found['dots']:.1f} ms with")


PARTS: dict[str, Callable[[PatternStudio, Ours, SensorDescription], None]] = {
    "pieces": pieces,
    "occlusions": occlusions,
    "slides": slides,
    "hard": hard,
    "exactness": exactness,
    "speed": speed,
}


def main() -> None:
    """Measure the parts that are asked for."""
    given = CommandLine(__doc__)
    given.option("--only", "run only these parts", nargs="+", choices=PARTS)
    asked = given.parse_args().only or PARTS
    cv2.setNumThreads(1)
    studio, tracker, sensor = PatternStudio(), Ours("cmp_tactile"), coded(load_sensor("sample_rig"))
    for name, measure in PARTS.items():
        if name in asked:
            measure(studio, tracker, sensor)


if __name__ == "__main__":
    main()
