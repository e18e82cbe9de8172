"""Where on a coded sheet a set of checkers lies, by their dots, and how sure that is.

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

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import bdtr, bdtrc

Float = NDArray[np.float64]
# Share of the dots that are misread, and the most that is reckoned with.
MISREAD, MOST_MISREAD = 0.05, 0.4
LARGEST_ODDS, LARGEST_CHANCE = 1e-9, 1e-5
# A view that is turned, mirrored or with colours exchanged is so much less likely than a right one.
UNEXPECTED = 1e-3
# Of the checkers that were read this share lies on the sheet: beside it a detector may see more.
LEAST_ON_SHEET = 0.8
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
