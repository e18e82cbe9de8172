"""The part of an image that shows the print, and what is wrong with it there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import MAD_TO_STD
from cmp_tactile_processing.tracking.print_inspection.defects import (
    Spots,
    find_spots,
)
from cmp_tactile_processing.tracking.print_inspection.picture import (
    Departure,
    PrintPlaces,
    SmoothLattice,
    departure,
    places_in_image,
)

# Too little of a grid to know where the print should be.
LEAST_CORNERS, LEAST_SHARE = 9, 0.3
# How far beyond the outermost corners the print is inspected, checkers: its rim's place is not
# measured, and blurred.
RIM = 0.6
# Where the lattice is extrapolated by a checker, edges may stray by so many times as much more.
RIM_STRAYING = 2.0
# A hole of up to two missing corners across is part of what is inspected: a spot made it.
HOLE = 3
# A spot spoils a corner within a Gaussian window: half its width, as a share of the side and in px
# at least.
CORNER_WINDOW_SIDES = 0.12
MIN_CORNER_WINDOW_PX = 1.2
# Shares of the window whose loss begins to weaken the corner, and destroys it.
WEAKENED_LOSS_SHARE = 0.05
DESTROYED_LOSS_SHARE = 0.3
# A corner so many typical deviations from the smooth lattice begins to lose weight.
CORNER_DEVIATIONS, LEAST_DEVIATION_PX = 4.0, 0.05
# So many neighbours that stray together by this share of a side do so because something presses on
# the gel.
PRESSED, PRESSED_SHARE = 8, 0.03
# A spot so near to a virtual marker, besides the blur, bends its gradient, px.
SPOT_REACH_PX = 1.5
# A virtual marker so many typical deviations off its smooth curve is astray.
MARKER_DEVIATIONS, LEAST_ASTRAY_PX = 5.0, 0.25

# Step along a gridline over which its direction is taken, checkers.
DIRECTION_STEP = 0.05


@dataclass(frozen=True)
class PrintView:
    """The part of a mean frame that shows the print, judged; places in px of that part.

    corners (rows, cols, 2): as measured.  judged_corners (rows, cols): where the print is in sight
    and at rest.  usable (H, W): pixels that could be judged.
    """

    corners: NDArray[np.float64]
    judged_corners: NDArray[np.bool_]
    lattice: SmoothLattice
    places: PrintPlaces
    usable: NDArray[np.bool_]
    departure: Departure
    spots: Spots
    side_px: float

    @classmethod
    def in_image(
        cls,
        image: NDArray[np.float32],
        noise: float,
        corners: NDArray[np.float64],
        steady: NDArray[np.bool_],
    ) -> PrintView | None:
        """None where the image (H, W) has no contrast or too little of the print, or but glare.

        steady (H,): rows in which the light was the same in all frames.
        """
        known = np.isfinite(corners[..., 0])
        if known.sum() < max(LEAST_CORNERS, LEAST_SHARE * known.size):
            return None
        side = side_of_checkers(corners)
        lattice = SmoothLattice.through(corners)
        places = places_in_image(lattice, known.shape, image.shape)
        usual = PRESSED_SHARE * side / _usual_px(lattice)
        sound = _filled(known) & ~_pressed(_astray(corners, lattice) > max(usual, 1))
        row = lattice.corners(*known.shape)[..., 1]
        sound &= steady[np.clip(np.rint(row), 0, len(steady) - 1).astype(int)]
        usable = _usable(places.number, sound) & steady[:, None]
        last = np.array([count - 1 for count in known.shape], dtype=np.float32)
        tolerance = 1 + RIM_STRAYING * _beyond(places.number, usable, last)
        found = departure(image, noise, places, usable, side)
        if found is None:
            return None
        spots = find_spots(found, usable, tolerance, side)
        if spots.glare.any():
            # Its light has spoilt what was expected around it.
            usable = usable & ~spots.glare
            if not usable.any():
                return None
            found = departure(image, noise, places, usable, side) or found
            spots = find_spots(found, usable, tolerance, side)
        return cls(corners, sound, lattice, places, usable & ~spots.glare, found, spots, side)

    @property
    def judged(self) -> float:
        """Share of the print that could be judged, 0 to 1."""
        rows, cols = self.corners.shape[:2]
        whole = (rows - 1 + 2 * RIM) * (cols - 1 + 2 * RIM)
        return float(min(1.0, np.count_nonzero(self.usable) * self._checkers_per_px / whole))

    @property
    def _checkers_per_px(self) -> float:
        """Mean over the usable pixels of the area of one, in checkers."""
        number, usable = self.places.number, self.usable[:-1, :-1]
        right = (number[:-1, 1:] - number[:-1, :-1])[usable]
        down = (number[1:, :-1] - number[:-1, :-1])[usable]
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        return float(np.nanmean(area)) if len(area) else 0.0

    def corner_weight(self) -> NDArray[np.float64]:
        """Weight of each corner (rows, cols), 0 to 1."""
        window = max(MIN_CORNER_WINDOW_PX, CORNER_WINDOW_SIDES * self.side_px)
        covered = self.spots.covered.astype(np.float32)
        lost = np.asarray(cv2.GaussianBlur(covered, (0, 0), window), dtype=np.float32)
        smooth = self.lattice.corners(*self.corners.shape[:2])
        weight = np.clip(
            (DESTROYED_LOSS_SHARE - sampled(lost, smooth))
            / (DESTROYED_LOSS_SHARE - WEAKENED_LOSS_SHARE),
            0,
            1,
        )
        astray, judged = _astray(self.corners, self.lattice), self.judged_corners
        weight = np.where(judged, weight / np.maximum(astray, 1), 1.0)
        # Not found at rest, amid others that were: there is nothing to measure.
        return np.where(judged & np.isnan(self.corners[..., 0]), 0.0, weight)

    def scatter(
        self, lines: NDArray[np.float64], std: NDArray[np.float64], along_rows: bool
    ) -> LineScatter:
        """Scatter of virtual markers lines (a, b, n, 2) px about their smooth curves.

        std (a, b, n): their noise, px; where it is NaN, what the image's noise makes of it.
        """
        scatter = line_scatter(self.lattice, lines, along_rows)
        slope = np.maximum(sampled(self.spots.gradient, scatter.smooth), 1e-3)
        by_image = sampled(self.departure.noise, scatter.smooth) / slope
        std = np.hypot(np.where(np.isnan(std), by_image, std), self.lattice.uncertainty_px)
        judged = np.asarray(sampled(self.usable.astype(np.float32), scatter.smooth) > 0)
        across = np.where(judged, scatter.across, np.nan)
        reach = SPOT_REACH_PX + sampled(self.departure.blur, scatter.smooth)
        doubtful = np.asarray(judged & (sampled(self._to_spot, scatter.smooth) < reach))
        known = np.isfinite(across)
        if known.any():
            usual = MAD_TO_STD * float(np.median(np.abs(across[known])))
            doubtful |= known & (np.abs(across) > max(MARKER_DEVIATIONS * usual, LEAST_ASTRAY_PX))
        return LineScatter(across, std, scatter.smooth, doubtful)

    @cached_property
    def _to_spot(self) -> NDArray[np.float32]:
        """Distance of each pixel (H, W) from the nearest spot, px."""
        if not self.spots.covered.any():
            return np.full(self.spots.covered.shape, np.inf, dtype=np.float32)
        clear = 1 - self.spots.covered.astype(np.uint8)
        return np.asarray(cv2.distanceTransform(clear, cv2.DIST_L2, 5), dtype=np.float32)


def side_of_checkers(corners: NDArray[np.float64]) -> float:
    """Median side of a checker, px."""
    steps = [np.linalg.norm(np.diff(corners, axis=axis), axis=-1).ravel() for axis in (0, 1)]
    sides = np.concatenate(steps)
    sides = sides[np.isfinite(sides)]
    return float(np.median(sides)) if len(sides) else 1.0


def _astray(corners: NDArray[np.float64], lattice: SmoothLattice) -> NDArray[np.float64]:
    """Distance (rows, cols) of the corners from the lattice over what is usual; 0 for missing."""
    distance = np.linalg.norm(corners - lattice.corners(*corners.shape[:2]), axis=-1)
    return np.asarray(np.nan_to_num(distance / _usual_px(lattice)))


def _usual_px(lattice: SmoothLattice) -> float:
    """How far corners may lie from the lattice without being astray, px."""
    return CORNER_DEVIATIONS * max(lattice.deviation_px, LEAST_DEVIATION_PX)


def _filled(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Known corners (rows, cols) and the small holes between them."""
    padded = np.pad(known, HOLE, mode="edge").astype(np.uint8)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((HOLE, HOLE), np.uint8))
    return np.asarray(closed, dtype=bool)[HOLE:-HOLE, HOLE:-HOLE]


def _pressed(astray: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Corners (rows, cols) in and around groups that stray together: the gel is not at rest."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(astray.astype(np.uint8))
    large = [label for label in range(1, count) if stats[label, cv2.CC_STAT_AREA] >= PRESSED]
    group = np.isin(labels, large).astype(np.uint8)
    return np.asarray(cv2.dilate(group, np.ones((5, 5), np.uint8)), dtype=bool)


def _usable(number: NDArray[np.float32], sound: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) of the print, up to its rim, on checkers whose corners are sound."""
    rows, cols = sound.shape
    whole = np.pad(sound, 1, mode="edge")
    checker = whole[:-1, :-1] & whole[1:, :-1] & whole[:-1, 1:] & whole[1:, 1:]
    with np.errstate(invalid="ignore"):
        i, j = number[..., 0], number[..., 1]
        inside = (i >= -RIM) & (i <= rows - 1 + RIM) & (j >= -RIM) & (j <= cols - 1 + RIM)
    usable = np.zeros(inside.shape, bool)
    # The outermost checkers begin at -1.
    usable[inside] = checker[(i[inside] + 1).astype(int), (j[inside] + 1).astype(int)]
    return usable


def _beyond(
    number: NDArray[np.float32], usable: NDArray[np.bool_], last: NDArray[np.float32]
) -> NDArray[np.float32]:
    """How far outside the outermost corners the usable pixels (H, W) are, checkers."""
    away = np.maximum(-number, number - last)
    beyond = np.where(usable, away.max(axis=-1), 0)
    return np.asarray(np.maximum(beyond, 0), dtype=np.float32)


def sampled(image: NDArray[np.float32], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """The image (H, W) at the pixels nearest to q (..., 2)."""
    height, width = image.shape
    x = np.clip(np.rint(q[..., 0]), 0, width - 1).astype(int)
    y = np.clip(np.rint(q[..., 1]), 0, height - 1).astype(int)
    return np.asarray(image[y, x], dtype=np.float64)


@dataclass(frozen=True)
class LineScatter:
    """Of the virtual markers (a, b, n) along one direction.

    across: px by which each lies beside its smooth curve, NaN where not measured; std: how much of
    that is noise, px; smooth (a, b, n, 2): its place on the curve, px; doubtful: markers that say
    nothing about the edge.
    """

    across: NDArray[np.float64]
    std: NDArray[np.float64]
    smooth: NDArray[np.float64]
    doubtful: NDArray[np.bool_]

    @property
    def measurable(self) -> NDArray[np.bool_]:
        """Markers (a, b, n) that show how the edge strays."""
        return np.isfinite(self.across) & ~self.doubtful

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of such markers in each segment (a, b)."""
        return np.asarray(self.measurable.sum(axis=-1), dtype=np.int64)

    @property
    def raggedness(self) -> NDArray[np.float64]:
        """Rms straying in each segment (a, b) without the noise's share, px; NaN where unknown."""
        total, count = self.square().sum(axis=-1), self.count
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(np.maximum(np.where(count > 0, total / count, np.nan), 0))

    def square(self, with_noise: bool = False) -> NDArray[np.float64]:
        """Square of each such marker's straying (a, b, n), px^2; 0 for the others."""
        noise = 0.0 if with_noise else np.nan_to_num(self.std) ** 2
        return np.where(self.measurable, self.across**2 - noise, 0.0)


def overall_raggedness(scatters: Sequence[LineScatter], with_noise: bool = False) -> float:
    """Rms straying over all such markers, px; NaN without any."""
    count = sum(int(scatter.count.sum()) for scatter in scatters)
    total = sum(float(scatter.square(with_noise).sum()) for scatter in scatters)
    return float(np.sqrt(max(total / count, 0.0))) if count else float("nan")


def _line_places(
    lattice: SmoothLattice, lines: tuple[int, int, int], along_rows: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (a, b, n, 2) px on the smooth curves of the virtual markers and the unit normals.

    lines: shape (a, b, n) of an array of markers, as in GridShape.
    """
    share = (np.arange(lines[2]) + 1.0) / (lines[2] + 1)
    first, second = (np.arange(count, dtype=np.float64) for count in lines[:2])
    i, j = (first, _between(second, share)) if along_rows else (_between(first, share), second)
    step = (0.0, DIRECTION_STEP) if along_rows else (DIRECTION_STEP, 0.0)
    place = lattice.at(i, j)
    along = lattice.at(i + step[0], j + step[1]) - lattice.at(i - step[0], j - step[1])
    length = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / length
    if along_rows:
        return place.reshape(*lines, 2), normal.reshape(*lines, 2)
    split = lines[0], lines[2], lines[1], 2
    return (
        np.ascontiguousarray(place.reshape(split).swapaxes(1, 2)),
        np.ascontiguousarray(normal.reshape(split).swapaxes(1, 2)),
    )


def _between(start: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((start[:, None] + share).ravel())


def line_scatter(
    lattice: SmoothLattice, lines: NDArray[np.float64], along_rows: bool
) -> LineScatter:
    """Scatter of virtual markers lines (a, b, n, 2) px, NaN where not measured.

    No noise is taken off, and no marker is taken for doubtful.
    """
    a, b, count = lines.shape[:3]
    smooth, normal = _line_places(lattice, (a, b, count), along_rows)
    across = ((lines - smooth) * normal).sum(axis=-1)
    return LineScatter(across, np.zeros_like(across), smooth, np.zeros(across.shape, bool))
