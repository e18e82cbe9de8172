"""The dots of coded patterns: which checkers bear one, and where on the sheet these checkers lie.

The dots that are read are compared with the sheet at every place, in all turns, mirrored, and with
dark and light exchanged.  Each dot is taken to be misread with the same probability, MISREAD, or
what the best place shows where that is more.  Then the odds of all other places against the best
are known (Bayes), and nothing is accepted where they exceed LARGEST_ODDS: of the components that
are numbered, no larger share can bear a wrong number.  What is no part of the sheet is random bits
to it: the chance that such bits agree as well at any place, at most the number of places times a
binomial tail, must be below LARGEST_CHANCE.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import bdtr, bdtrc

from cmp_tactile_processing.image.prepared import MEDIAN_OF_NORMAL, PreparedImage
from cmp_tactile_processing.tracking.corners.neighbours import predicted_places

Float = NDArray[np.float64]

# Where a checker's grey levels are looked at, in sides from its middle: on the dot, beside it, and
# close to the sides.
ON_DOT = np.array([(0, 0), (-0.05, 0), (0.05, 0), (0, -0.05), (0, 0.05)])
BESIDE = 0.25 * np.array([(-1, -1), (-1, 1), (1, -1), (1, 1), (-1, 0), (1, 0), (0, -1), (0, 1)])

CLOSE = 0.36 * np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
# A checker counts where it differs from those beside it by this share of what is usual, and where
# its own grey levels beside the dot scatter by less than a share of that.
LEAST_CONTRAST, MOST_SCATTER = 0.4, 0.3
# Checkers with a dot and without are distinguished if their levels differ by this share of the
# contrast, and by this many times the scatter of each.
MIN_DOT_CONTRAST = 0.04
MIN_DOT_SCATTER_RATIO = 3.5
# Levels in the middle, within this share of the difference, are not known.
UNKNOWN_BAND_SHARE = 0.2
# Levels need so many checkers, and a plane of them over the image so many of each kind.
MIN_LEVEL_CHECKERS = 12
LEVEL_ROUNDS = 8
# Weaker dots are no proof of another code: what blur makes of checkers looks the same.
LEAST_PROOF = 0.2
# Of the checkers of a code half have a dot, to this share.
MAX_SHARE_OFF_HALF = 0.2
# Where edges are so sharp (see `sharpness`) and checkers so large, dots would be seen.
SHARP, LEAST_SIDE_PX = 0.92, 8.0

# Share of the dots that are misread, and the most that is reckoned with.
MISREAD, MOST_MISREAD = 0.05, 0.4
LARGEST_ODDS, LARGEST_CHANCE = 1e-9, 1e-5
# A view that is turned, mirrored or with colours exchanged is so much less likely than a right one.
UNEXPECTED = 1e-3
# Of the checkers that were read this share lies on the sheet: beside it a detector may see more.
LEAST_ON_SHEET = 0.8


@dataclass(frozen=True)
class Cells:
    """The checkers that touch the corners of a lattice (R, C); checker (0, 0) lies before (0, 0).

    middle (R + 1, C + 1, 2) px; down, right (R + 1, C + 1, 2) px: along i and along j, from side to
    side.  NaN for checkers that touch no known corner.
    """

    middle: Float
    down: Float
    right: Float

    @classmethod
    def around(cls, lattice: Float) -> Cells:
        """The checkers around corners (R, C, 2) px, NaN where not known.

        Corners that are not known lie where their neighbours have them.
        """
        corners = np.pad(lattice, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        seen = np.isfinite(corners[..., 0])
        for _ in range(2):
            corners = np.where(np.isnan(corners), predicted_places(corners), corners)
        touched = seen[:-1, :-1] | seen[:-1, 1:] | seen[1:, :-1] | seen[1:, 1:]
        corners = np.asarray(corners)
        first, last = corners[:-1], corners[1:]
        middle = (first[:, :-1] + first[:, 1:] + last[:, :-1] + last[:, 1:]) / 4
        down = (last[:, :-1] + last[:, 1:] - first[:, :-1] - first[:, 1:]) / 2
        right = (first[:, 1:] + last[:, 1:] - first[:, :-1] - last[:, :-1]) / 2
        known = touched[..., None]
        return cls(*(np.where(known, part, np.nan) for part in (middle, down, right)))

    def places(self, offsets: Float) -> Float:
        """Pixels (..., n, 2) at offsets (n, 2) from the middles, in sides along i and along j."""
        a, b = offsets[:, :1], offsets[:, 1:]
        return np.asarray(
            self.middle[..., None, :] + a * self.down[..., None, :] + b * self.right[..., None, :]
        )


BESIDE[4:] *= 1.15


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
    def is_code(self) -> bool:
        """Whether so many of the checkers have a clear dot as in a code: flaws are fewer."""
        known = self.bits[self.bits != 0]
        share = float(np.mean(known > 0)) if len(known) else 0.0
        return self.is_clear and abs(share - 0.5) < MAX_SHARE_OFF_HALF

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
    bits[good] = np.where(
        np.abs(share - 0.5) > UNKNOWN_BAND_SHARE / 2, np.where(share > 0.5, 1, -1), 0
    )
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
    if len(values) < MIN_LEVEL_CHECKERS:
        return None
    low, high = np.percentile(values, [10, 90])
    none, some = np.full_like(values, low), np.full_like(values, high)
    terms = np.column_stack([np.ones(len(values)), place - place.mean(axis=0)])
    for number in range(LEVEL_ROUNDS):
        upper = values > (none + some) / 2
        fewest = min(np.count_nonzero(upper), np.count_nonzero(~upper))
        if fewest == 0:
            return None
        used = (
            terms if fewest >= MIN_LEVEL_CHECKERS and number >= LEVEL_ROUNDS // 2 else terms[:, :1]
        )
        none, some = (
            used @ np.linalg.lstsq(used[chosen], values[chosen], rcond=None)[0]
            for chosen in (~upper, upper)
        )
    scatter = np.median(np.abs(values - np.where(upper, some, none))) / MEDIAN_OF_NORMAL
    apart = (some - none).min()
    return (none, some) if apart >= max(MIN_DOT_CONTRAST, MIN_DOT_SCATTER_RATIO * scatter) else None


TURNS = tuple((turns, mirrored) for mirrored in (False, True) for turns in range(4))


@dataclass(frozen=True)
class Decoding:
    """The likeliest place of a set of checkers on the sheet.

    shift (2,): row and column of checker (0, 0) of the set, from the origin, where it is upright.
    turns: quarter turns by which the sheet is seen turned, counter-clockwise in the image;
    mirrored: by columns, after that; exchanged: dark checkers are seen light.
    odds: of all other places against this one.  by_chance: bound on the probability that random
    dots agree as well.  readable, misread: checkers on the sheet there, and those that disagree.
    """

    shift: NDArray[np.intp]
    turns: int
    mirrored: bool
    exchanged: bool
    odds: float
    by_chance: float
    readable: int
    misread: int

    @property
    def is_certain(self) -> bool:
        """Whether the place can be relied on."""
        return self.odds <= LARGEST_ODDS and self.by_chance <= LARGEST_CHANCE

    @property
    def is_foreign(self) -> bool:
        """Whether more dots disagree than can be misread: the checkers are not of this sheet."""
        by_misreading = bdtrc(self.misread - 1, self.readable, MISREAD) if self.misread else 1.0
        return not self.is_certain and bool(by_misreading <= LARGEST_ODDS)


class DotDecoder:
    """Decodes sets of checkers of one sheet.

    dots (rows, cols): which of its checkers bear one; dark_first: whether checker (0, 0) is dark.
    origin: the checker of the sheet from which shifts count.
    """

    def __init__(
        self, dots: NDArray[np.bool_], dark_first: bool, origin: tuple[int, int] = (0, 0)
    ) -> None:
        self._origin = np.array(origin)
        self._sheets = [_seen(np.where(dots, 1.0, -1.0), *view) for view in TURNS]
        dark = (np.indices(dots.shape).sum(axis=0) % 2 == 0) == dark_first
        self._dark_first = np.array([bool(_seen(dark, *view)[0, 0]) for view in TURNS])
        self._spectra: dict[int, tuple[NDArray[np.complex128], NDArray[np.complex128]]] = {}

    def decode(
        self,
        bits: NDArray[np.int8],
        dark: bool,
        within: tuple[NDArray[np.intp], NDArray[np.intp]] | None = None,
    ) -> Decoding | None:
        """The likeliest place of checkers; None where no place has them.

        bits (h, w): 1 a dot, -1 none, 0 not known; dark: whether checker (0, 0) is seen dark.
        within: least and largest shift, both (2,), where only these come into question, upright.
        """
        views = len(TURNS) if within is None else 1
        agreement, count, shift = self._compared(bits, views)
        colours = (shift.sum(axis=-1) % 2 == 0) == (self._dark_first[:views, None, None] == dark)
        shift = shift - self._origin
        expected = colours & (np.arange(views) == 0)[:, None, None]
        possible = count >= max(LEAST_ON_SHEET * np.count_nonzero(bits), 1.0)
        if within is not None:
            possible &= expected & ((shift >= within[0]) & (shift <= within[1])).all(axis=-1)
        if not possible.any():
            return None
        found = agreement[possible], count[possible], np.where(expected, 1.0, UNEXPECTED)[possible]
        best = int(np.argmax(_log_odds(*found, MISREAD)))
        view, *place = (int(index[best]) for index in np.nonzero(possible))
        readable = round(found[1][best])
        misread = round((found[1][best] - found[0][best]) / 2)
        rate = float(np.clip(misread / readable, MISREAD, MOST_MISREAD))
        against = _log_odds(*found, rate) - _log_odds(*found, rate)[best]
        kind = possible & (expected == expected[view, place[0], place[1]])
        return Decoding(
            shift=shift[place[0], place[1]],
            turns=TURNS[view][0],
            mirrored=TURNS[view][1],
            exchanged=not colours[view, place[0], place[1]],
            odds=float(np.exp(np.minimum(np.delete(against, best), 700.0)).sum()),
            by_chance=float(np.count_nonzero(kind) * bdtr(misread, readable, 0.5)),
            readable=readable,
            misread=misread,
        )

    def evidence(self, bits: NDArray[np.int8], shift: NDArray[np.intp]) -> float:
        """Logarithm of the odds of a place, upright, against that of random dots; bits as above."""
        sheet = self._sheets[0]
        cells = np.argwhere(bits != 0)
        places = cells + shift + self._origin
        on_sheet = ((places >= 0) & (places < sheet.shape)).all(axis=1)
        read, printed = bits[tuple(cells[on_sheet].T)], sheet[tuple(places[on_sheet].T)]
        agreement = np.array(float((read * printed).sum()))
        return float(_log_odds(agreement, np.array(float(len(read))), np.ones(()), MISREAD))

    def _compared(
        self, bits: NDArray[np.int8], views: int
    ) -> tuple[Float, Float, NDArray[np.intp]]:
        """Agreeing less disagreeing checkers at each place, those on the sheet, and the places.

        (views, n, n) twice, the first axis that of the first of TURNS, and (n, n, 2) shifts.
        """
        longest = max(self._sheets[0].shape)
        side = int(next_fast_len(longest + max(bits.shape) - 1, real=True))
        if side not in self._spectra:
            self._spectra = {side: self._spectra_of(side)}
        printed, covered = self._spectra[side]
        shape = (side, side)
        read = np.conj(rfft2(bits.astype(np.float64), shape))
        known = np.conj(rfft2((bits != 0).astype(np.float64), shape))
        agreement = np.rint(irfft2(printed[:views] * read, shape))
        count = np.rint(irfft2(covered[:views] * known, shape))
        along = np.arange(side)
        along = np.where(along < longest, along, along - side)
        shift = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1)
        return agreement, count, shift

    def _spectra_of(self, side: int) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        shape = (side, side)
        printed = np.stack([rfft2(sheet, shape) for sheet in self._sheets])
        covered = np.stack([rfft2(np.ones_like(sheet), shape) for sheet in self._sheets])
        return printed, covered


def _seen(sheet: NDArray[Any], turns: int, mirrored: bool) -> NDArray[Any]:
    """A sheet as it is seen turned by quarters, then mirrored."""
    turned = np.rot90(sheet, turns)
    return turned[:, ::-1] if mirrored else turned


def _log_odds(agreement: Float, count: Float, weight: Float, rate: float) -> Float:
    """Log odds of places against random dots, where a share `rate` of the dots is misread."""
    right, wrong = np.log(2 * (1 - rate)), np.log(2 * rate)
    return np.asarray((count * (right + wrong) + agreement * (right - wrong)) / 2 + np.log(weight))
