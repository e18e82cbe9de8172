"""Broken frames: the numbers in them must be right, or the view must report a fault.

Each kind of `BROKEN_KINDS` spoils good frames in another way. To add a kind, write a function from
good frames of one rig and a random generator to a `Trial`, and add a line to `BROKEN_KINDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from detectors import Image
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cmp_tactile_processing.measured import ForceField, ForceFlag, Grid, GridFault, Status
from cmp_tactile_processing.pipeline import Pipeline
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Roi
from hard_frames.covers import Cover
from hard_frames.deformation import jump
from hard_frames.studio import PatternCase, PatternFrame, PatternStudio, disc, streak

Float = NDArray[np.float64]

# A corner is misnumbered where it lies within this share of a checker's side of another corner.
ANOTHER_CORNER = 0.35
# Faults with which corners may be numbered: whoever uses them sees nothing that is wrong.
SILENT = (GridFault.NONE, GridFault.PARTLY_HIDDEN)
# Whoever uses a force with one of these flags knows that it may be another.
DOUBTED = (
    ForceFlag.FEW_MARKERS
    | ForceFlag.AT_BORDER
    | ForceFlag.BEYOND_MARKERS
    | ForceFlag.HIDDEN_CONTACT
    | ForceFlag.NOT_CONVERGED
    | ForceFlag.POOR_FIT
    | ForceFlag.IMPLAUSIBLE
    | ForceFlag.ZERO_DOUBTFUL
    | ForceFlag.DESCRIPTION_DOUBTFUL
)
# A force is another one where it differs by more than so many deviations, this share and this, N.
DEVIATIONS, FORCE_SHARE, LEAST_FORCE_N = 3.0, 0.1, 0.03
# Of the trials of a kind, this share shows the good frame first: the broken one is followed.
FOLLOWED = 0.5


@dataclass(frozen=True)
class Trial:
    """Images (H, W) uint8 that are processed in their order from a fresh start; the last is judged.

    places (n, rows, cols, 2): px of the whole frame; where the last image shows each corner, n
    times (views, or parts of several frames), NaN where it does not.
    sources: the good images that the last one was made of.
    doubted: a view with this confidence at most says by it how little its numbers rest on.
    """

    images: Sequence[Image]
    places: Float
    sources: Sequence[Image]
    doubted: float = -1.0


@dataclass(frozen=True)
class BrokenScore:
    """Counts over trials: silent: those in which a corner is misnumbered and no fault says so.

    wrong: corners that are misnumbered in them; right: measured corners that are not, in all
    trials; faults: views with a fault other than partly_hidden.  wrong_forces: trials with a force
    that no flag doubts and that is none of the good images', see `is_wrong_force`.
    """

    trials: int = 0
    silent: int = 0
    wrong: int = 0
    right: int = 0
    faults: int = 0
    wrong_forces: int = 0


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
    good: dict[bytes, ForceField] = {}

    def force_of(image: Image) -> ForceField:
        key = image.tobytes()
        if key not in good:
            pipeline.reset()
            good[key] = pipeline.process(image).force
        return good[key]

    for index in range(count):
        rng = np.random.default_rng([seed, list(BROKEN_KINDS).index(kind), index])
        trial = BROKEN_KINDS[kind](frames, rng)
        forces = [force_of(image) for image in trial.sources]
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
            silent += 0 if loud or grid.confidence <= trial.doubted else wrong
            total = replace(total, right=total.right + right, faults=total.faults + loud)
        total = replace(
            total,
            silent=total.silent + (silent > 0),
            wrong=total.wrong + silent,
            wrong_forces=total.wrong_forces + is_wrong_force(result.force, forces),
        )
    return total


def is_wrong_force(force: ForceField, good: Sequence[ForceField]) -> bool:
    """Whether a force without a flag is none of those of the good images.

    Nothing is known where one of the good images has no force, or a doubtful one.
    """
    if force.flags & DOUBTED or not np.isfinite(force.wrench).all():
        return False
    if any(item.flags & DOUBTED or not np.isfinite(item.wrench).all() for item in good):
        return False
    return not any(
        (
            np.abs(force.wrench[:3] - item.wrench[:3])
            <= DEVIATIONS * np.hypot(force.wrench_std[:3], item.wrench_std[:3])
            + FORCE_SHARE * np.linalg.norm(item.wrench[:3])
            + LEAST_FORCE_N
        ).all()
        for item in good
    )


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
    return _trial(frame, broken, places_of(frame), rng)


def _trial(frame: PatternFrame, broken: Image, places: Float, rng: np.random.Generator) -> Trial:
    """What a good frame was made into, after the good one or alone."""
    before = [frame.image] if rng.random() < FOLLOWED else []
    return Trial([*before, broken], places, [frame.image])


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
    turned = places @ turn[:, :2].T + turn[:, 2]
    return _trial(frame, np.asarray(image, np.uint8), turned, rng)


def _torn(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """The upper rows of one frame above the lower rows of another, after either of them or alone.

    Half of the pairs are a knock: the gel moves by a checker and more in between.
    """
    upper, lower = _one_of(frames, rng), _one_of(frames, rng)
    if rng.random() < 0.5:
        far = [frame for frame in frames if _moved(frame, upper) > 1.0]
        lower = _one_of(far, rng) if far else lower
    row = _row_across(upper, rng)
    image = np.concatenate([upper.image[:row], lower.image[row:]])
    above, below = places_of(upper), places_of(lower)
    above[above[..., 1] >= row] = np.nan
    below[below[..., 1] < row] = np.nan
    before = [(upper, lower)[int(rng.integers(2))].image] if rng.random() < FOLLOWED else []
    return Trial([*before, image], np.concatenate([above, below]), [upper.image, lower.image])


def _lost(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """Bytes are lost: all that follows comes earlier, by a part of a row or by up to 120 rows."""
    frame = _one_of(frames, rng)
    height, width = frame.image.shape
    row = _row_across(frame, rng)
    lost = int(rng.integers(1, width)) if rng.random() < 0.7 else 0
    lost += width * int(rng.integers(1, 120)) if rng.random() < 0.6 or not lost else 0
    stream = frame.image.ravel().copy()
    stream[row * width : -lost] = frame.image.ravel()[row * width + lost :]
    above, below = places_of(frame), places_of(frame)
    above[above[..., 1] >= row] = np.nan
    # A row's first pixels come to the end of the row before.
    x, y = below[..., 0] - lost % width, below[..., 1] - lost // width
    below = np.stack([np.where(x < 0, x + width, x), np.where(x < 0, y - 1, y)], axis=-1)
    below[below[..., 1] < row] = np.nan
    places = np.concatenate([above, below])
    return _trial(frame, stream.reshape(height, width), places, rng)


def _row_across(frame: PatternFrame, rng: np.random.Generator) -> int:
    """A row of the frame that crosses the pattern."""
    y = places_of(frame)[..., 1]
    return int(rng.uniform(np.nanmin(y), np.nanmax(y)))


def _moved(frame: PatternFrame, other: PatternFrame) -> float:
    """Median motion between two frames, in checkers."""
    places = places_of(frame)
    side = np.nanmedian(np.linalg.norm(np.diff(places, axis=2), axis=-1))
    return float(np.nanmedian(np.linalg.norm(places - places_of(other), axis=-1)) / side)


def _false_border(frames: Sequence[PatternFrame], rng: np.random.Generator) -> Trial:
    """A gel knocked by two checkers, its two outermost lines on that side covered, as the far side.

    What covers them ends along a gridline, where the pattern ended before, and looks like the
    margin: the view shows what it would show without the knock.  After the gel at rest, or alone.
    """
    sensor, studio = frames[0].sensor, _studio()
    way = int(rng.integers(4))
    shift = [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)][way] + rng.uniform(-0.2, 0.2, 2)
    # Columns grow along x, rows along y: which runs up in the image.
    far_side = ("right", "left", "bottom", "top")[way]
    cover = Cover(far_side, rng.uniform(0.2, 0.4), rng.uniform(15.0, 60.0))
    zones = jump(sensor, (float(shift[0]), float(shift[1])), rng.uniform(0.0, 5e-4))
    case = PatternCase("false border", sensor, zones, cover=cover, seed=int(rng.integers(1000)))
    frame = studio.photograph(case)
    image = frame.image.copy()
    for name, grid in frame.truth.items():
        if grid.placement is None:
            continue
        lines = grid.corners_frame if way > 1 else grid.corners_frame.swapaxes(0, 1)
        _cover_lines(image, lines[::-1] if way in {0, 2} else lines, sensor.views[name].roi)
    images = [image]
    if rng.random() < FOLLOWED:
        images.insert(0, studio.photograph(PatternCase("rest", sensor)).image)
    return Trial(images, places_of(frame), [frame.image], doubted=0.5)


def _cover_lines(image: Image, lines: Float, roi: Roi) -> None:
    """Paint what lies beyond the second line, as bright as the margin.

    lines (n, m, 2) px, from the outermost inwards: the third of them then looks like the outermost.
    """
    outwards = lines[0] - lines[1]
    margin = np.rint(lines[0] + 1.6 * outwards).astype(np.intp)
    inside = (margin >= (roi.x, roi.y)).all(axis=1)
    inside &= (margin < (roi.x + roi.width, roi.y + roi.height)).all(axis=1)
    grey = np.median(image[margin[inside, 1], margin[inside, 0]])
    edge, beyond = lines[1], lines[0] + 2.5 * outwards
    ends = (
        [2 * line[0] - line[2] for line in (edge, beyond)],
        [2 * line[-1] - line[-3] for line in (edge, beyond)],
    )
    outline = np.concatenate(
        [[ends[0][0]], edge, [ends[1][0]], [ends[1][1]], beyond[::-1], [ends[0][1]]]
    )
    part = image[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width]
    covered = np.zeros(part.shape, np.uint8)
    cv2.fillPoly(covered, [np.rint(outline - (roi.x, roi.y)).astype(np.int32)], 1)
    part[covered > 0] = grey


@cache
def _studio() -> PatternStudio:
    return PatternStudio(samples=2)


BROKEN_KINDS: dict[str, Spoil] = {
    "out of focus (disc)": _out_of_focus,
    "smeared": _smeared,
    "turned": _turned,
    "torn": _torn,
    "rows lost or rolled": _lost,
    "false border": _false_border,
}
