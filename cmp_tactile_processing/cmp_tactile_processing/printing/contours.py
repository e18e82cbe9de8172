"""Outlines of the ink: checkers, dots, and what lies between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.parts import Pattern

__all__ = [
    "Contour",
    "checker_contours",
    "dot_contours",
    "inset",
    "light_checker_contours",
    "on_print",
    "rectangle",
    "without",
]

MOST_HALVINGS = 20
# Where an image is compared with its chord, as shares of the side.
LOOKED_AT = (0.25, 0.5, 0.75)

Contour = NDArray[np.float64]
"""(N, 2) corners of a closed polygon, the last joined to the first.

Where y points up and x to the right, ink lies to the left of its way: counter-clockwise around
ink, clockwise around a hole in it.
"""


def rectangle(half_x: float, half_y: float) -> Contour:
    """A rectangle of ink about the origin."""
    return np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])


def without(contours: list[Contour]) -> list[Contour]:
    """Holes in place of ink, and ink in place of holes."""
    return [contour[::-1] for contour in contours]


def checker_contours(pattern: Pattern) -> list[Contour]:
    """Squares of the dark checkers, x and y of the gel frame, m.  They share corners only."""
    return [_on_gel(pattern, square) for square in _squares(pattern, dark=True)]


def light_checker_contours(pattern: Pattern) -> list[Contour]:
    """Ink of a light surrounding without the dark checkers: the hole in it, and what is left there.

    Light checkers at the border are one with their surrounding, so the hole is a comb.
    """
    inner = [
        square
        for square in _squares(pattern, dark=False)
        if square.min() >= 1 and (square.max(axis=0) <= (pattern.cols, pattern.rows)).all()
    ]
    return [_on_gel(pattern, contour) for contour in (_comb(pattern)[::-1], *inner)]


def dot_contours(pattern: Pattern, diameter: float, tolerance: float) -> list[Contour]:
    """Dots of that diameter at the places of the corners; m, as polygons within `tolerance`."""
    radius = diameter / 2
    count = max(12, math.ceil(math.pi / math.acos(1 - min(tolerance / radius, 0.5))))
    angles = np.arange(count) * (2 * math.pi / count)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return [centre + circle for centre in pattern.corners()[..., :2].reshape(-1, 2)]


def on_print(
    contours: list[Contour],
    flat: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    tolerance: float,
) -> list[Contour]:
    """Contours laid flat, with so many corners that straight sides bend within `tolerance`."""
    return [flat(_divided(contour, flat, tolerance)) for contour in contours]


def inset(contour: Contour, by: float) -> Contour:
    """The contour with every side moved into the ink by that much; negative: out of it."""
    if by == 0:
        return contour
    sides = np.roll(contour, -1, axis=0) - contour
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    after = np.stack([-sides[:, 1], sides[:, 0]], axis=-1)
    before = np.roll(after, 1, axis=0)
    towards = (before + after) / (1 + (before * after).sum(axis=1, keepdims=True))
    return np.asarray(contour + by * towards)


def _is_dark(pattern: Pattern, row: int, col: int) -> bool:
    """Of the checker outside corner (row, col): that of (0, 0) is the description's."""
    return (row + col) % 2 == (0 if pattern.corner_checker == "dark" else 1)


def _squares(pattern: Pattern, *, dark: bool) -> Iterator[Contour]:
    """In checkers: x from 0 to cols + 1, y from 0 to rows + 1."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    for row in range(pattern.rows + 1):
        for col in range(pattern.cols + 1):
            if _is_dark(pattern, row, col) == dark:
                yield square + (col, row)


def _comb(pattern: Pattern) -> Contour:
    """Around all checkers but the light ones of the border, counter-clockwise, in checkers."""
    width, height = pattern.cols + 1, pattern.rows + 1
    sides: list[tuple[int, Callable[[float, float], tuple[float, float]]]] = [
        (width, lambda along, deep: (along, deep)),
        (height, lambda along, deep: (width - deep, along)),
        (width, lambda along, deep: (width - along, height - deep)),
        (height, lambda along, deep: (deep, height - along)),
    ]
    points = []
    for length, place in sides:
        for k in range(length - 1):
            col, row = (math.floor(value) for value in place(k + 0.5, 0.5))
            points += [place(*point) for point in _tooth(k, dark=_is_dark(pattern, row, col))]
    return np.array(points, dtype=np.float64)


def _tooth(k: int, *, dark: bool) -> list[tuple[float, float]]:
    """Way around the k-th checker of a side, (along, deep); the first lies at the corner."""
    if k == 0:
        return [(0, 0)] if dark else [(0, 1), (1, 1), (1, 0)]
    return [] if dark else [(k, 0), (k, 1), (k + 1, 1), (k + 1, 0)]


def _on_gel(pattern: Pattern, checkers: Contour) -> Contour:
    return pattern.at(checkers[:, 1] - 1, checkers[:, 0] - 1)[:, :2]


def _divided(
    contour: Contour,
    flat: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    tolerance: float,
) -> Contour:
    """With sides halved until each one's image lies within `tolerance` of its chord."""
    for _ in range(MOST_HALVINGS):
        ends = np.roll(contour, -1, axis=0)
        begin = flat(contour)
        chord = flat(ends) - begin
        across = np.zeros(len(contour))
        for share in LOOKED_AT:
            away = flat(contour * (1 - share) + ends * share) - begin
            bend = np.abs(chord[:, 0] * away[:, 1] - chord[:, 1] * away[:, 0])
            across = np.maximum(across, bend)
        bent = np.flatnonzero(across > tolerance * np.linalg.norm(chord, axis=1))
        if not len(bent):
            break
        contour = np.insert(contour, bent + 1, (contour[bent] + ends[bent]) / 2, axis=0)
    return contour
