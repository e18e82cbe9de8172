"""The code of a pattern: which checkers bear a dot, so that each part of a print shows its place.

A checker with a dot in its middle is a 1, one without a 0.  Any WINDOW x WINDOW checkers of a
sheet, with their colours, occur once: in any of the four turns, and not in the sheet's mirror image
either.  A sheet is the corner at (0, 0) of the largest one with the same seed.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

WINDOW = 4
# Checkers along a side of the largest sheet.  More than about 75 have too few windows left.
LARGEST_SHEET = 61
LARGEST_SEED = 65535
# Of a dot, as a share of the pitch.
DOT_DIAMETER = 0.18


def dot_map(rows: int, cols: int, seed: int = 0) -> NDArray[np.bool_]:
    """Which of rows x cols checkers bear a dot, (rows, cols), read-only.

    No version changes it: a print must stay readable.
    Raises ValueError for more than LARGEST_SHEET checkers along a side.
    """
    if not 0 < min(rows, cols) <= max(rows, cols) <= LARGEST_SHEET:
        msg = f"sheet: found {rows} x {cols} checkers, expected 1 to {LARGEST_SHEET} along a side"
        raise ValueError(msg)
    return _largest_sheet(seed)[:rows, :cols]


def window_words(dots: NDArray[np.bool_], first_dark: bool) -> NDArray[np.intp]:
    """Each window of a sheet as a number, (rows - 3, cols - 3): its dots, and its first colour.

    first_dark: whether checker (0, 0) is dark.
    """
    windows = np.lib.stride_tricks.sliding_window_view(dots, (WINDOW, WINDOW))
    words = windows.reshape(*windows.shape[:2], -1) @ (1 << np.arange(WINDOW**2))
    odd = np.indices(words.shape).sum(axis=0) % 2
    return np.asarray(words + ((odd ^ int(first_dark)) << WINDOW**2), dtype=np.intp)


@lru_cache(maxsize=1)
def window_orbits() -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For each number of a window: the least of the eight that turns and mirrors make of it, and
    whether one of these leaves it as it is, so that it does not show how it is turned.
    """
    count = WINDOW**2
    bits = (np.arange(2**count)[:, None] >> np.arange(count)) & 1
    weights = (1 << np.arange(count)).reshape(WINDOW, WINDOW)
    images = []
    for turns in range(4):
        for mirrored in (False, True):
            turned = np.rot90(weights, turns)
            turned = turned[:, ::-1] if mirrored else turned
            word = bits @ turned.ravel()
            # A quarter turn and a mirror each put a checker of the other colour first.
            other = (turns + mirrored) % 2
            images.append(np.concatenate([word + ((colour ^ other) << count) for colour in (0, 1)]))
    seen = np.stack(images)
    return seen.min(axis=0), (seen[1:] == seen[0]).any(axis=0)


@lru_cache(maxsize=8)
def _largest_sheet(seed: int) -> NDArray[np.bool_]:
    """The largest sheet of a seed.

    Checkers are chosen one after the other, in shells around (0, 0), so that each completes one
    window; where neither a dot nor none is allowed, the last choices are taken back.
    """
    places = [
        place
        for shell in range(LARGEST_SHEET)
        for place in (*((k, shell) for k in range(shell)), *((shell, k) for k in range(shell + 1)))
    ]
    # A hash is the same wherever and whenever it is computed.
    liked = hashlib.shake_256(f"cmp_tactile dots {seed}".encode()).digest(len(places))
    search = _Search()
    tried = [0] * len(places)
    k = 0
    while k < len(places):
        if tried[k] == 2:
            tried[k] = 0
            k -= 1
            search.take_back(places[k])
            continue
        bit = (liked[k] & 1) ^ tried[k]
        tried[k] += 1
        k += search.choose(places[k], bit)
    sheet = np.array(search.bits, dtype=np.bool_)
    sheet.flags.writeable = False
    return sheet


class _Search:
    """A sheet in the making: its bits, and the windows that it has already."""

    def __init__(self) -> None:
        least, same = window_orbits()
        self._least, self._same = least.tolist(), same.tolist()
        self._used: set[int] = set()
        self._of: dict[tuple[int, int], int] = {}
        self.bits = [[0] * LARGEST_SHEET for _ in range(LARGEST_SHEET)]

    def choose(self, place: tuple[int, int], bit: int) -> bool:
        """Set a checker; whether the window that it completes, if any, is a new one."""
        row, col = place
        self.bits[row][col] = bit
        if min(place) < WINDOW - 1:
            return True
        word = ((row + col) & 1) << WINDOW**2
        for k in range(WINDOW**2):
            i, j = divmod(k, WINDOW)
            word |= self.bits[row - WINDOW + 1 + i][col - WINDOW + 1 + j] << k
        least = self._least[word]
        if self._same[word] or least in self._used:
            return False
        self._used.add(least)
        self._of[place] = least
        return True

    def take_back(self, place: tuple[int, int]) -> None:
        """Forget the window that a checker completed."""
        if place in self._of:
            self._used.remove(self._of.pop(place))
