"""Which checkers in an image bear a dot."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.dots.cells import Cells

Float = NDArray[np.float64]
# Where a checker's grey levels are looked at, in sides from its middle: on the dot, beside it, and
# close to the sides.
ON_DOT = np.array([(0, 0), (-0.05, 0), (0.05, 0), (0, -0.05), (0, 0.05)])
BESIDE = 0.25 * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1), (-1, 0), (1, 0), (0, -1), (0, 1)])
BESIDE[4:] *= 1.15
CLOSE = 0.36 * np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
# A checker counts where it differs from those beside it by this share of what is usual, and where
# its own grey levels beside the dot scatter by less than a share of that.
LEAST_CONTRAST, MOST_SCATTER = 0.4, 0.3
# Dots and the lack of dots are distinguished where they differ by so much, as a share of the
# contrast and of the scatter of each; what lies between them by less than a share is not known.
LEAST_STRENGTH, LEAST_RATIO, BETWEEN = 0.04, 3.5, 0.2
FEWEST_CHECKERS, FEWEST_OF_PLANE, ROUNDS = 12, 12, 8
# Median of |x| of a normal distribution of standard deviation 1.
MEDIAN_OF_NORMAL = 0.6745
# Weaker dots are no proof of another code: what blur makes of checkers looks the same.
LEAST_PROOF = 0.2
# Where edges are so sharp (see `sharpness`) and checkers so large, dots would be seen.
SHARP, LEAST_SIDE_PX = 0.92, 8.0


@dataclass(frozen=True)
class DotReading:
    """The dots around a lattice of corners (R, C).

    bits (R + 1, C + 1) int8: 1 a dot, -1 none, 0 not known.  strength: by how much dots change the
    grey level of a checker's middle, as a share of the contrast; NaN where none are distinguished.
    sharpness: of the contrast, what is left close to the checkers' sides: 1 where edges are sharp.
    side_px: of a checker.
    """

    bits: NDArray[np.int8]
    strength: float
    sharpness: float
    side_px: float

    @classmethod
    def nothing(cls, shape: tuple[int, ...]) -> DotReading:
        """No dot is known around corners (R, C)."""
        bits = np.zeros((shape[0] + 1, shape[1] + 1), dtype=np.int8)
        return cls(bits, float("nan"), float("nan"), float("nan"))

    @property
    def is_clear(self) -> bool:
        """Whether dots are seen so well that they can be those of another code."""
        return self.strength >= LEAST_PROOF

    @property
    def is_bare(self) -> bool:
        """Whether checkers without any dots are seen sharply."""
        sharp = self.side_px >= LEAST_SIDE_PX and self.sharpness >= SHARP
        return bool(sharp and np.isnan(self.strength))


def read_dots(image: PreparedImage, lattice: Float, even: bool) -> DotReading:
    """The dots in the checkers around corners (R, C, 2) px, NaN where not known.

    even: whether dark checkers touch corner (0, 0) along the diagonal (-, -) to (+, +).
    """
    cells = Cells.around(lattice)
    dot, beside, close = _levels(image, cells)
    level = beside.mean(axis=-1)
    around = _mean_of_neighbours(level)
    contrast = around - level
    dark = (np.indices(level.shape).sum(axis=0) % 2 == 0) == even
    towards = np.where(dark, contrast, -contrast)
    with np.errstate(invalid="ignore", divide="ignore"):
        usual = _median(towards[towards > 0])
        good = towards > LEAST_CONTRAST * usual
        good &= beside.std(axis=-1) < MOST_SCATTER * towards
        strength = np.where(good, (dot.mean(axis=-1) - level) / contrast, np.nan)
        sharpness = _median(((around - close.mean(axis=-1)) / contrast)[good])
        side = _median(np.linalg.norm(cells.down, axis=-1)[good])
    bits = np.zeros(level.shape, dtype=np.int8)
    found = _two_levels(strength[good], np.argwhere(good).astype(np.float64))
    if found is None:
        return DotReading(bits, float("nan"), sharpness, side)
    none, some = found
    share = (strength[good] - none) / (some - none)
    bits[good] = np.where(np.abs(share - 0.5) > BETWEEN / 2, np.where(share > 0.5, 1, -1), 0)
    return DotReading(bits, float(np.median(some - none)), sharpness, side)


def _levels(image: PreparedImage, cells: Cells) -> tuple[Float, Float, Float]:
    """Grey levels (R + 1, C + 1, n) on the dots, beside them and close to the sides."""
    offsets = np.concatenate([ON_DOT, BESIDE, CLOSE])
    places = cells.places(offsets)
    height, width = image.grey.shape
    x, y = places[..., 0], places[..., 1]
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    # Of no more than 32767 rows and columns, as OpenCV wants it.
    flat = np.where(inside[..., None], places, 0).astype(np.float32)
    flat = flat.reshape(len(places), -1, 2)
    grey = image.grey.astype(np.float32)
    levels = cv2.remap(grey, flat, np.empty(0), cv2.INTER_LINEAR).reshape(inside.shape)
    seen = np.where(inside, levels, np.nan).astype(np.float64)
    dot, beside, close = np.split(seen, [len(ON_DOT), len(ON_DOT) + len(BESIDE)], axis=-1)
    return dot, beside, close


def _mean_of_neighbours(values: Float) -> Float:
    """Mean of the known ones of the four neighbours of each, NaN where none is known."""
    padded = np.pad(values, 1, constant_values=np.nan)
    four = np.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
    known = np.isfinite(four)
    count = known.sum(axis=0)
    total = np.where(known, four, 0.0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _median(values: Float) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _two_levels(values: Float, place: Float) -> tuple[Float, Float] | None:
    """The lower and the upper of two levels (n,) around which values (n,) lie.

    None where they are one.
    place (n, 2): each level may change along a plane, as blur and the size of checkers do.
    """
    if len(values) < FEWEST_CHECKERS:
        return None
    low, high = np.percentile(values, [10, 90])
    none, some = np.full_like(values, low), np.full_like(values, high)
    terms = np.column_stack([np.ones(len(values)), place - place.mean(axis=0)])
    for number in range(ROUNDS):
        upper = values > (none + some) / 2
        fewest = min(np.count_nonzero(upper), np.count_nonzero(~upper))
        if fewest == 0:
            return None
        used = terms if fewest >= FEWEST_OF_PLANE and number >= ROUNDS // 2 else terms[:, :1]
        none, some = (
            used @ np.linalg.lstsq(used[chosen], values[chosen], rcond=None)[0]
            for chosen in (~upper, upper)
        )
    scatter = np.median(np.abs(values - np.where(upper, some, none))) / MEDIAN_OF_NORMAL
    apart = (some - none).min()
    return (none, some) if apart >= max(LEAST_STRENGTH, LEAST_RATIO * scatter) else None
