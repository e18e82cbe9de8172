"""Broken frames: what is numbered in them must be right, or the view must report a fault.

Each kind of `BROKEN_KINDS` spoils good frames in its own way.  A new kind is a function from good
frames of one rig and a random generator to a `Trial`, and a line in `BROKEN_KINDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from extraction_detectors import Image
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.grid import Grid, GridFault, Status
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_simulation.pattern_case import PatternFrame

__all__ = ["BROKEN_KINDS", "BrokenScore", "Trial", "misnumbered", "places_of", "run_broken"]

Float = NDArray[np.float64]

# A corner is misnumbered where it lies within this share of a checker's side of another corner.
ANOTHER_CORNER = 0.35
# Faults with which corners may be numbered: whoever uses them sees nothing that is wrong.
SILENT = (GridFault.NONE, GridFault.PARTLY_HIDDEN)
# Of the trials of a kind, this share shows the good frame first: the broken one is followed.
FOLLOWED = 0.5


@dataclass(frozen=True)
class Trial:
    """Images (H, W) uint8 that are processed in their order from a fresh start; the last is judged.

    places (n, rows, cols, 2): px of the whole frame; where the last image shows each corner, n
    times (views, or parts of several frames), NaN where it does not.
    """

    images: Sequence[Image]
    places: Float


@dataclass(frozen=True)
class BrokenScore:
    """Counts over trials: silent: those in which a corner is misnumbered and no fault says so.

    wrong: corners that are misnumbered in them; right: measured corners that are not, in all
    trials; faults: views with a fault other than partly_hidden.
    """

    trials: int = 0
    silent: int = 0
    wrong: int = 0
    right: int = 0
    faults: int = 0


Spoil = Callable[[Sequence[PatternFrame], np.random.Generator], Trial]


def run_broken(
    kind: str,
    frames: Sequence[PatternFrame],
    sensor: SensorDescription,
    count: int = 200,
    seed: int = 0,
) -> BrokenScore:
    """Trials of a kind through `Pipeline`, both views, made from good frames of the sensor.

    sensor: with the detector that is to be judged.
    """
    pipeline = Pipeline(sensor)
    total = BrokenScore(count)
    for index in range(count):
        rng = np.random.default_rng([seed, list(BROKEN_KINDS).index(kind), index])
        trial = BROKEN_KINDS[kind](frames, rng)
        pipeline.reset()
        for image in trial.images[:-1]:
            pipeline.process(image)
        result = pipeline.process(trial.images[-1])
        silent = 0
        for grid in (result.left, result.right):
            if grid is None:
                continue
            wrong, right = misnumbered(grid, trial.places)
            loud = grid.fault not in SILENT
            silent += 0 if loud else wrong
            total = replace(total, right=total.right + right, faults=total.faults + loud)
        total = replace(total, silent=total.silent + (silent > 0), wrong=total.wrong + silent)
    return total


def misnumbered(grid: Grid, places: Float) -> tuple[int, int]:
    """Measured corners of a grid that lie at another corner's place, and those that do not.

    places: as in `Trial`.
    """
    measured = grid.corner_status == Status.MEASURED
    numbers = np.flatnonzero(measured)
    flat = places.reshape(len(places), -1, 2)
    known = np.isfinite(flat[..., 0])
    if not len(numbers) or not known.any():
        return 0, len(numbers)
    sides = [np.linalg.norm(np.gradient(places, axis=axis), axis=-1) for axis in (1, 2)]
    side = np.fmin(*sides).reshape(len(places), -1)
    side = np.where(np.isfinite(side), side, np.nanmedian(side))[known]
    corner = np.nonzero(known)[1]
    distance, nearest = cKDTree(flat[known]).query(grid.corners_frame[measured])
    wrong = (corner[nearest] != numbers) & (distance < ANOTHER_CORNER * side[nearest])
    return int(wrong.sum()), int((~wrong).sum())


def places_of(frame: PatternFrame) -> Float:
    """Where the whole frame shows each corner, (views, rows, cols, 2) px."""
    return np.stack([grid.corners_frame for grid in frame.truth.values()])


def _one_of(frames: Sequence[PatternFrame], rng: np.random.Generator) -> PatternFrame:
    return frames[int(rng.integers(len(frames)))]


def _blurred(frame: PatternFrame, kernel: Float, rng: np.random.Generator) -> Trial:
    """The frame convolved with a kernel, after the good one or alone."""
    spread = kernel / kernel.sum()
    image = cv2.filter2D(frame.image, cv2.CV_32F, spread, borderType=cv2.BORDER_REPLICATE)
    noisy = image + rng.normal(0.0, rng.uniform(0.0, 1.5), image.shape)
    broken = noisy.round().clip(0, 255).astype(np.uint8)
    before = [frame.image] if rng.random() < FOLLOWED else []
    return Trial([*before, broken], places_of(frame))


def _out_of_focus(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """A disc of 12 to 26 px radius: around the first zero of the checkers' transfer function."""
    return _blurred(_one_of(frames, rng), disc(rng.uniform(12.0, 26.0)), rng)


def _smeared(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """The gel moves by 15 to 60 px, straight and evenly, while the frame is exposed."""
    return _blurred(
        _one_of(frames, rng), streak(rng.uniform(15.0, 60.0), rng.uniform(0.0, np.pi)), rng
    )


def _turned(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """Turned by 25 to 335 degrees, about the middle of the frame or of one view's pattern."""
    frame = _one_of(frames, rng)
    places = places_of(frame)
    near = rng.uniform(-25.0, 25.0) + 90.0 * rng.integers(1, 4)
    angle = near if rng.random() < 0.8 else rng.uniform(25.0, 335.0)
    height, width = frame.image.shape
    centres = [np.array([(width - 1) / 2, (height - 1) / 2])]
    centres += [np.nanmean(view.reshape(-1, 2), axis=0) for view in places]
    centre = centres[int(rng.integers(len(centres)))]
    turn = cv2.getRotationMatrix2D((float(centre[0]), float(centre[1])), angle, 1.0)
    image = cv2.warpAffine(
        frame.image, turn, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    before = [frame.image] if rng.random() < FOLLOWED else []
    return Trial([*before, np.asarray(image, np.uint8)], places @ turn[:, :2].T + turn[:, 2])


def disc(radius: float) -> Float:
    """The image of a point out of focus, (n, n): a disc with a soft rim of one pixel."""
    reach = int(np.ceil(radius)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray((radius + 0.5 - np.hypot(x, y)).clip(0.0, 1.0))


def streak(length: float, angle: float) -> Float:
    """The image of a point that moves by so many px in that direction, rad; (n, n)."""
    reach = int(np.ceil(length / 2)) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along = np.abs(x * np.cos(angle) + y * np.sin(angle))
    across = np.abs(y * np.cos(angle) - x * np.sin(angle))
    return np.asarray((length / 2 + 0.5 - along).clip(0, 1) * (1.0 - across).clip(0, 1))


BROKEN_KINDS: dict[str, Spoil] = {
    "out of focus (disc)": _out_of_focus,
    "smeared": _smeared,
    "turned": _turned,
}
