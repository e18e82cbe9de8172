"""The flaws of a print, in numbers of the grid, so that they hold however the gel moves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.image.light_bands import LightBands
from cmp_tactile_processing.measured import MAD_TO_STD
from cmp_tactile_processing.tracking.print_inspection.flawed_corners import FlawedCorners
from cmp_tactile_processing.tracking.print_inspection.picture import SMOOTHING_PX, Departure

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
# So many defects are named one by one in a report.
NAMED = 5
# What departs must exceed all of these together; 2 is the contrast between ink and skin.
LEAST_AMOUNT = 0.12
NOISE_DEVIATIONS = 5.5
# Edges stray: so many of their typical deviations, and so many px at least, are not a spot.
EDGE_DEVIATIONS, LEAST_STRAYING_PX = 3.5, 0.1
# A spot goes on around its peak down to this share of what it must exceed; smaller ones than
# LEAST_AREA_PX are noise.
SKIRT, LEAST_AREA_PX = 0.6, 4
# Ink is there or not: a spot of less than this share of what blur leaves of one of its size is
# light or shade.
LEAST_OPACITY = 0.25
# On an edge: a gradient of this share of the steepest.
ON_EDGE = 0.5
# No flaw of the print makes skin lighter than bare skin.  Glare is what exceeds it by more than
# MIN_GLARE where a level above MIN_SKIN_LEVEL is expected.
MIN_GLARE = 0.2
MIN_SKIN_LEVEL = 0.5
# Around glare nothing is judged, in checkers.
GLARE_MARGIN_CHECKERS = 1.5


class DefectKind(str, Enum):
    """What kind of flaw it is."""

    MISSING_INK = "missing_ink"
    DIRT = "dirt"
    RAGGED_EDGE = "ragged_edge"


@dataclass(frozen=True)
class Defect:
    """A flaw of the print.

    row, col: its centre in grid numbers, corner (i, j) at (i, j); on the outermost checkers they
    are below 0 or beyond the last number.  centre_px (2,): in the view image that was inspected.
    extent_px: diameter of the disc of its area, or of a ragged edge the length.
    strength: a spot's peak as a share of the contrast between ink and skin; of a ragged edge the
    rms by which it strays, px.
    """

    kind: DefectKind
    row: float
    col: float
    centre_px: NDArray[np.float64]
    extent_px: float
    strength: float

    @property
    def cell(self) -> tuple[int, int]:
        """The checker (i, j) that it is on, between corners (i, j) and (i + 1, j + 1)."""
        return int(np.floor(self.row)), int(np.floor(self.col))


@dataclass(frozen=True)
class PrintDefects:
    """The state of a print.

    corner_weight (rows, cols): 1 for a sound corner, 0 for one that is destroyed; its standard
    deviation divided by this is what it is worth.
    row_line_doubtful (rows, cols-1, n), col_line_doubtful (rows-1, cols, n): virtual markers so
    close to a spot, or so far astray, that they are better predicted than measured.
    row_raggedness (rows, cols-1), col_raggedness (rows-1, cols): rms by which the printed edge
    strays from its smooth curve in each segment, noise taken off, px; NaN where not measured.
    raggedness_px: the same over all segments.
    judged: share of the print that could be inspected, 0 to 1; what was not counts as sound.
    frames: number of frames averaged.
    bands: of light that changed between the frames; rows in which it did are not inspected.
    flawed: pictures of the corners that are measured by these; all corners where edges are ragged.
    """

    corner_weight: NDArray[np.float64]
    row_line_doubtful: NDArray[np.bool_]
    col_line_doubtful: NDArray[np.bool_]
    row_raggedness: NDArray[np.float64]
    col_raggedness: NDArray[np.float64]
    raggedness_px: float
    defects: Sequence[Defect]
    judged: float
    frames: int
    bands: LightBands
    flawed: FlawedCorners

    @property
    def report(self) -> str:
        """The state of the print in one paragraph."""
        counts = Counter(defect.kind for defect in self.defects)
        found = ", ".join(
            f"{counts[kind]} {name if counts[kind] == 1 else plural}"
            for kind, name, plural in (
                (DefectKind.MISSING_INK, "spot without ink", "spots without ink"),
                (DefectKind.DIRT, "spot of dirt or excess ink", "spots of dirt or excess ink"),
                (DefectKind.RAGGED_EDGE, "ragged edge", "ragged edges"),
            )
            if counts[kind]
        )
        frames = f"{self.frames} frame{'s' if self.frames != 1 else ''}"
        text = f"Print, {self.judged:.0%} of it inspected in {frames}: {found or 'no defects'}."
        largest = sorted(self.defects, key=lambda defect: -defect.extent_px)[:NAMED]
        spots = [item for item in largest if item.kind is not DefectKind.RAGGED_EDGE]
        if spots:
            named = "; ".join(
                f"{spot.kind.value.replace('_', ' ')} at row {spot.row:.1f}, column {spot.col:.1f} "
                f"({spot.extent_px:.1f} px)"
                for spot in spots
            )
            text += f" Largest: {named}."
        if np.isfinite(self.raggedness_px):
            text += f" Edges stray by {self.raggedness_px:.2f} px rms."
        destroyed = int(np.count_nonzero(self.corner_weight == 0))
        weakened = int(np.count_nonzero(self.corner_weight < 1)) - destroyed
        doubtful = int(self.row_line_doubtful.sum() + self.col_line_doubtful.sum())
        if destroyed or weakened or doubtful:
            text += (
                f" {destroyed} corners are destroyed, {weakened} weakened; "
                f"{doubtful} virtual markers are doubtful."
            )
        if by_picture := int(self.flawed.known.sum()):
            text += f" {by_picture} corners are measured by their pictures."
        flicker = self.bands.report
        return f"{text} Rows are not inspected where {flicker}." if flicker else text


# Spots of missing ink or dirt: connected pixels that no edge, light or noise explains.


@dataclass(frozen=True)
class Spot:
    """centre_px (2,); extent_px: diameter of the disc of its area; strength: share of contrast."""

    kind: DefectKind
    centre_px: NDArray[np.float64]
    extent_px: float
    strength: float


@dataclass(frozen=True)
class Spots:
    """The spots, the pixels (H, W) that lie on one, and those that glare left unjudged."""

    spots: list[Spot]
    covered: Mask
    glare: Mask
    gradient: Image


def find_spots(departure: Departure, usable: Mask, tolerance: Image, side_px: float) -> Spots:
    """Spots among the usable pixels (H, W) of an image with checkers of that side.

    tolerance (H, W): how many times as far as usual an edge may stray in each pixel.
    """
    expected = np.asarray(cv2.GaussianBlur(departure.expected, (0, 0), SMOOTHING_PX), np.float32)
    gradient = _gradient(expected)
    amount, noise = departure.amount, NOISE_DEVIATIONS * departure.noise
    straying = _straying(amount, gradient, usable)
    steepest = _steepest_within(gradient, straying)
    least = LEAST_AMOUNT + noise + straying * tolerance * steepest
    on_skin = usable & (expected > MIN_SKIN_LEVEL)
    glare = _glare(amount - (1 - expected), MIN_GLARE + noise, on_skin, side_px)
    covered, spots = np.zeros(usable.shape, bool), []
    for kind, sign in ((DefectKind.MISSING_INK, 1), (DefectKind.DIRT, -1)):
        allowed = usable & ~glare if sign > 0 else usable
        excess = np.where(allowed, sign * amount / least, 0).astype(np.float32)
        for (centre, extent, strength), place, pixels in _connected(sign * amount, excess):
            x, y = np.rint(centre).astype(int)
            if strength > LEAST_OPACITY * _sharp_strength(extent, departure.blur[y, x]):
                spots.append(Spot(kind, centre, extent, strength))
                covered[place] |= pixels
    return Spots(spots, covered, glare, gradient)


def _sharp_strength(extent_px: float, blur_px: float) -> float:
    """Peak of a disc of full contrast that appears that large after the lens and the smoothing."""
    variance = blur_px**2 + SMOOTHING_PX**2
    # A point appears 2 sqrt(2 ln 2) standard deviations wide.
    square = max(extent_px**2 - 8 * np.log(2) * variance, 0.0)
    return float(1 - np.exp(-square / 8 / variance))


def _gradient(expected: Image) -> Image:
    """Length of the gradient of what is expected, per px."""
    along_x = cv2.Scharr(expected, cv2.CV_32F, 1, 0, scale=1 / 32)
    along_y = cv2.Scharr(expected, cv2.CV_32F, 0, 1, scale=1 / 32)
    return np.asarray(cv2.magnitude(along_x, along_y), dtype=np.float32)


def _straying(amount: Image, gradient: Image, usable: Mask) -> float:
    """By how much edges may stray that are not a spot, px, from how they typically do."""
    edge = usable & (gradient > ON_EDGE * float(np.quantile(gradient[usable], 0.95)))
    typical = MAD_TO_STD * float(np.median(np.abs(amount[edge] / gradient[edge])))
    return EDGE_DEVIATIONS * typical + LEAST_STRAYING_PX


def _steepest_within(gradient: Image, reach_px: float) -> Image:
    """Largest gradient within so many px of each pixel: where a straying edge may come to lie."""
    radius = round(reach_px)
    if radius < 1:
        return gradient
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.dilate(gradient, disc), dtype=np.float32)


def _glare(beyond: Image, least: Image, on_skin: Mask, side_px: float) -> Mask:
    seeds = (on_skin & (beyond > least)).astype(np.uint8)
    # A single pixel is noise.
    seeds = np.asarray(cv2.morphologyEx(seeds, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)))
    if not seeds.any():
        return seeds.astype(bool)
    away = cv2.distanceTransform(1 - seeds, cv2.DIST_L2, 3)
    return np.asarray(away < GLARE_MARGIN_CHECKERS * side_px)


def _connected(
    amount: Image, excess: Image
) -> list[tuple[tuple[NDArray[np.float64], float, float], tuple[slice, slice], Mask]]:
    """Centre, extent and strength, place in the image and pixels of each spot.

    excess: share of what a spot must exceed.
    """
    skirt = (excess > SKIRT).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(skirt, connectivity=8)
    found = []
    for label in range(1, count):
        x, y, width, height, area = (int(value) for value in stats[label])
        if area < LEAST_AREA_PX:
            continue
        place = slice(y, y + height), slice(x, x + width)
        inside = labels[place] == label
        if not (excess[place][inside] > 1).any():
            continue
        values = np.where(inside, amount[place], 0)
        peak = float(values.max())
        core = values > peak / 2
        rows, cols = np.nonzero(core)
        centre = np.average(np.stack([cols + x, rows + y], axis=1), axis=0, weights=values[core])
        extent = 2 * float(np.sqrt(core.sum() / np.pi))
        found.append(((centre, extent, peak / 2), place, core))
    return found
