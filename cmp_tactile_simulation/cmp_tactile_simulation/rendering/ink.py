"""Printed patterns: the grey of the skin as a function of material coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.pattern import Pattern
from cmp_tactile_simulation.rendering.ink_kernel import CHECKERS, DOTS, InkArrays, Print, ink_on
from cmp_tactile_simulation.rendering.print_defects import (
    PrintDefects,
    scatter_blobs,
    stray_lattice,
)
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream

__all__ = [
    "DARK_GREY",
    "HOUSING_GREY",
    "LIGHT_GREY",
    "PATTERN_TYPES",
    "Checkerboard",
    "Dots",
    "Ink",
    "ink_of",
]

# Greys of the noise-free frame; the camera settings say what a camera makes of them.
DARK_GREY, LIGHT_GREY, HOUSING_GREY = 45.0, 205.0, 18.0
PATTERN_TYPES = ("cmp", "dmp")


class Ink(Protocol):
    """A print on the skin."""

    @property
    def arrays(self) -> InkArrays:
        """What the renderer's compiled code reads."""


@dataclass(frozen=True)
class Checkerboard:
    """Continuous marker pattern: (rows + 1) x (cols + 1) checkers with their inner corners.

    margin: grey of the skin around the checkers.  Print defects are set by the seed.
    """

    pattern: Pattern
    defects: PrintDefects = field(default_factory=PrintDefects)
    seed: int = 0
    margin: float = LIGHT_GREY

    @cached_property
    def arrays(self) -> InkArrays:
        """What the renderer's compiled code reads."""
        return _arrays(self.pattern, CHECKERS, self.margin, (self.defects, self.seed))

    def grey(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Greys (...) at material points (..., 2) m, the gel frame's x and y at rest."""
        return _grey(self.arrays, xy)


@dataclass(frozen=True)
class Dots:
    """Discrete marker pattern: a dark dot at each of the rows x cols places of the corners.

    diameter: of a dot, as a share of the pitch.  Print defects are set by the seed.
    Raises ParameterError unless the diameter is positive and dots stay apart.
    """

    pattern: Pattern
    defects: PrintDefects = field(default_factory=PrintDefects)
    seed: int = 0
    diameter: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.diameter < 1:
            msg = f"dots.diameter: found {self.diameter}, expected more than 0 and less than 1"
            raise ParameterError(msg)

    @cached_property
    def arrays(self) -> InkArrays:
        """What the renderer's compiled code reads."""
        arrays = _arrays(self.pattern, DOTS, LIGHT_GREY, (self.defects, self.seed))
        radius = self.diameter * self.pattern.pitch / 2
        return arrays._replace(plain=arrays.plain._replace(dot_radius=radius))

    def grey(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Greys (...) at material points (..., 2) m, the gel frame's x and y at rest."""
        return _grey(self.arrays, xy)


def ink_of(
    pattern: Pattern, pattern_type: str, defects: PrintDefects | None = None, seed: int = 0
) -> Checkerboard | Dots:
    """The print of that type: "cmp" checkers or "dmp" dots; ParameterError for another."""
    defects = defects or PrintDefects()
    if pattern_type == "cmp":
        return Checkerboard(pattern, defects, seed)
    if pattern_type == "dmp":
        return Dots(pattern, defects, seed)
    msg = f"pattern_type: found {pattern_type!r}, expected one of {', '.join(PATTERN_TYPES)}"
    raise ParameterError(msg)


def _grey(arrays: InkArrays, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    flat = np.ascontiguousarray(xy, dtype=np.float64).reshape(-1, 2)
    return np.asarray(ink_on(arrays, flat)).reshape(np.shape(xy)[:-1])


def _arrays(
    pattern: Pattern, kind: int, margin: float, flaws: tuple[PrintDefects, int]
) -> InkArrays:
    defects, seed = flaws
    size = (pattern.cols + 1) * pattern.pitch, (pattern.rows + 1) * pattern.pitch
    # Apart, so that more blobs leave the edges as they are.
    edge_rng, blob_rng = (
        random_stream(purpose, seed) for purpose in (Purpose.PRINT_EDGES, Purpose.PRINT_BLOBS)
    )
    plain = Print(
        kind=kind,
        rows=pattern.rows,
        cols=pattern.cols,
        pitch=float(pattern.pitch),
        first_dark=int(pattern.corner_checker == "dark"),
        dot_radius=0.0,
        dark=DARK_GREY,
        light=LIGHT_GREY,
        margin=float(margin),
    )
    if not (defects.missing_ink or defects.splashes or defects.ragged_edge):
        return InkArrays(plain, None, None)
    strays = stray_lattice(defects, size, edge_rng)
    blobs = scatter_blobs(defects, size, (LIGHT_GREY, DARK_GREY), blob_rng)
    flawed = plain._replace(
        stray_x=strays.x,
        stray_y=strays.y,
        stray_per=strays.per,
        stray_slope=strays.slope,
        stray_most=strays.most,
        bin_x=blobs.x,
        bin_y=blobs.y,
        bin_per=blobs.per,
        bin_margin=blobs.margin,
    )
    return InkArrays(flawed, strays.values, blobs.bins)
