"""Flaws of a printed pattern, as fixed functions of the place on the skin."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError
from cmp_tactile_processing.sensor.parameters import check_parameters, parameter

__all__ = ["Blobs", "PrintDefects", "Strays", "scatter_blobs", "stray_lattice"]

# A lattice point of the strays lies within so many standard deviations.
LARGEST_DEVIATION = 2.5
# Mean over a cell of what smooth steps between independent points leave of their variance.
KEPT_VARIANCE = (26 / 35) ** 2
MAX_LATTICE = 4000
# Longer over shorter half-axis of a blob, at most.
LONGEST_BLOB = 1.6
# Bins beyond the print: a blob at its rim reaches there, and what is beyond them is in the last.
AROUND = 3


@dataclass(frozen=True)
class PrintDefects:
    """What is wrong with the print; the places are set by the seed.

    Raises ParameterError for a value outside its range.
    """

    missing_ink: int = parameter(0, "number of blobs without ink on the pattern", low=0, high=10000)
    splashes: int = parameter(0, "number of blobs of ink on the pattern", low=0, high=10000)
    blob_radius: float = parameter(
        8e-5,
        "mean radius of a blob; single ones have half to one and a half of it",
        unit="m",
        low=1e-6,
        high=5e-3,
    )
    ragged_edge: float = parameter(
        0.0, "standard deviation by which the printed edges stray", unit="m", low=0, high=2e-4
    )
    ragged_length: float = parameter(
        5e-5, "length over which the edges' straying changes", unit="m", low=1e-5, high=5e-3
    )

    def __post_init__(self) -> None:
        check_parameters(self, "print")


@dataclass(frozen=True)
class Strays:
    """Straying of the print: values (h, w, 2) m on a lattice from (x, y) m, `per` points a m.

    slope: its largest change over a distance, per that distance.  most: twice its largest amount.
    """

    values: NDArray[np.float32]
    x: float = 0.0
    y: float = 0.0
    per: float = 0.0
    slope: float = 0.0
    most: float = 0.0


@dataclass(frozen=True)
class Blobs:
    """Elliptic blobs in bins: bins (h, w, k, 8) from (x, y) m, `per` to a m; see InkArrays.

    A bin lists the blobs that come nearer to it than `margin`, m.
    """

    bins: NDArray[np.float64]
    x: float
    y: float
    per: float
    margin: float


def stray_lattice(
    defects: PrintDefects, size: tuple[float, float], rng: np.random.Generator
) -> Strays:
    """Straying over a print of that size (x, y) m.

    Raises ParameterError where the print is too large for so small a length.
    """
    if defects.ragged_edge == 0:
        return Strays(np.zeros((2, 2, 2), np.float32))
    length = defects.ragged_length
    reach = LARGEST_DEVIATION * defects.ragged_edge
    cols, rows = (math.ceil((side + 2 * reach) / length) + 1 for side in size)
    if max(rows, cols) > MAX_LATTICE:
        least = max(size) / MAX_LATTICE
        msg = f"print.ragged_length: found {length:g}, expected at least {least:.2g} m here"
        raise ParameterError(msg)
    noise = rng.standard_normal((rows, cols, 2)).clip(-LARGEST_DEVIATION, LARGEST_DEVIATION)
    values = noise * (defects.ragged_edge / math.sqrt(KEPT_VARIANCE))
    steps = [np.linalg.norm(np.diff(values, axis=axis), axis=-1).max() for axis in (0, 1)]
    # A smooth step is 1.5 times as steep at its middle as on average.
    slope = 1.5 * float(np.hypot(*steps)) / length
    x, y = -(cols - 1) * length / 2, -(rows - 1) * length / 2
    most = 2 * float(np.linalg.norm(values, axis=-1).max())
    return Strays(values.astype(np.float32), x, y, 1 / length, slope, most)


def scatter_blobs(
    defects: PrintDefects,
    size: tuple[float, float],
    greys: tuple[float, float],
    rng: np.random.Generator,
) -> Blobs:
    """Blobs without ink, then splashes, of these greys, anywhere on a print of size (x, y) m."""
    count = defects.missing_ink + defects.splashes
    centre = rng.uniform(-0.5, 0.5, (count, 2)) * size
    radius = defects.blob_radius * rng.uniform(0.5, 1.5, count)
    stretch = np.sqrt(rng.uniform(1, LONGEST_BLOB, count))
    angle = rng.uniform(0, np.pi, count)
    cosine, sine = np.cos(angle), np.sin(angle)
    along, across = 1 / (radius * stretch), stretch / radius
    columns = [centre[:, 0], centre[:, 1]]
    columns += [cosine * along, sine * along, -sine * across, cosine * across, radius / stretch]
    columns.append(np.repeat(greys, [defects.missing_ink, defects.splashes]))
    side = max(2 * defects.blob_radius, max(size) / 60)
    x, y = -size[0] / 2 - AROUND * side, -size[1] / 2 - AROUND * side
    cols, rows = (math.ceil(extent / side) + 2 * AROUND for extent in size)
    middle_x = x + side * (np.arange(cols) + 0.5)
    middle_y = y + side * (np.arange(rows) + 0.5)
    # The margin is one side of a bin, from any point of it.
    reach = radius * stretch + 1.5 * side
    near_x = np.abs(middle_x[:, None] - centre[:, 0]) <= reach
    near_y = np.abs(middle_y[:, None] - centre[:, 1]) <= reach
    bins = _binned(np.stack(columns, axis=1), near_y, near_x)
    return Blobs(bins, x, y, 1 / side, side)


def _binned(
    blobs: NDArray[np.float64], near_y: NDArray[np.bool_], near_x: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Bins (h, w, k, 8) of blobs (n, 8); near_y (h, n), near_x (w, n): those that reach it."""
    listed = near_y[:, None] & near_x[None]
    bins = np.full((*listed.shape[:2], max(int(listed.sum(axis=2).max()), 1), 8), np.nan)
    for row, col in np.argwhere(listed.any(axis=2)):
        own = blobs[listed[row, col]]
        bins[row, col, : len(own)] = own
    return bins
