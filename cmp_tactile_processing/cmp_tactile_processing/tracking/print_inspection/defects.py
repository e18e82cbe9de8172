"""The flaws of a print: how an image departs from what an undamaged print would look like.

They are in numbers of the grid, so that they hold however the gel moves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel
from cmp_tactile_processing.tracking.print_inspection.flawed_corners import FlawedCorners

Image = NDArray[np.float32]
# Standard deviations of the blur that are tried, px; neighbours differ so little that the rest is
# below what a spot must reach.
BLURS = (0.3, 0.5, 0.7, 0.9, 1.15, 1.45, 1.8, 2.25, 2.8, 3.5, 4.4)
# Blurs tried in each part of the image, in steps around that of the whole.
LOCAL_STEPS = 2
# What departs is smoothed by so much before it is judged, px.
SMOOTHING_PX = 1.0
# Light and shade over the whole image are polynomials of this degree in x and y.
LIGHT_DEGREE = 3
# About so many pixels determine the light over the whole image.
LIGHT_SAMPLES = 4000
ROUNDS = 2
LEAST_PIXELS = 200
# What departs by more than this share of half the contrast does not count for light and blur.
OUTLIER = 0.5
# Half the contrast is at least this share of its median, and so many grey levels.
LEAST_CONTRAST, LEAST_GREY = 0.15, 2.0
# A knot about every so many checkers, and at most so many spans: the print at rest bends little,
# and the fit must average over enough corners to leave out a damaged one.
CHECKERS_PER_KNOT, MOST_SPANS = 3, 10
ROBUST_ROUNDS = 6
# A corner that lies so many typical deviations off counts half as much.
HALF_WEIGHT = 2.5
# Keeps the weights finite where corners are exact, px.
LEAST_DEVIATION_PX = 0.01
# Penalty of the spline's coefficients' third differences, so that hidden parts do not run wild.
SMOOTHNESS = 1e-4
# A checker is taken to pieces of half its side, within which the map is bilinear.
PIECES = 2
# So many defects are named one by one in a report.
NAMED = 5
Mask = NDArray[np.bool_]
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
# No flaw of the print makes skin lighter than bare skin: what does by more than this, where light
# is expected by more than that, is glare, and so far around it, in checkers, nothing is judged.
GLARE, ON_SKIN, GLARE_REACH = 0.2, 0.5, 1.5


@dataclass(frozen=True)
class Departure:
    """An image against an undamaged print; all but the blur and the noise are (H, W) images.

    expected: -1 on dark ink, +1 on light skin, blurred as the image is.
    amount: image minus expectation in the same scale, smoothed by SMOOTHING_PX.
    noise: standard deviation of `amount`'s noise.  blur: of the edges, px.
    """

    expected: Image
    amount: Image
    noise: Image
    blur: Image


def departure(
    grey: Image, noise: float, places: PrintPlaces, usable: NDArray[np.bool_], side_px: float
) -> Departure | None:
    """How an image (H, W) departs from what the print should look like; None without contrast.

    noise: standard deviation of the image's noise, grey levels.  usable (H, W): pixels that show
    the print and are not too close to its rim.
    """
    if np.count_nonzero(usable) < LEAST_PIXELS:
        return None
    trusted, samples = usable, _Samples.from_trusted(usable)
    pictures = [_blurred(places.checker, sigma) for sigma in BLURS]
    best = int(np.argmin([samples.fit(grey, picture)[1] for picture in pictures]))
    for _ in range(ROUNDS):
        light = _light(grey, pictures[best], samples)
        if light is None:
            return None
        middle, half = light
        seen = np.asarray((grey - middle) / half, dtype=np.float32)
        expected, blur = _expected(seen, pictures, trusted, (best, side_px))
        rest, gain = _without_local_light(seen, expected, trusted, side_px)
        trusted = usable & (np.abs(rest) < OUTLIER)
        samples = _Samples.from_trusted(trusted)
    if float(np.mean(half[usable])) < 0:
        expected, rest = -expected, -rest
    amount = np.where(usable, _masked_blur(rest, usable), 0).astype(np.float32)
    scale = 1 / (2 * np.sqrt(np.pi) * SMOOTHING_PX)
    return Departure(expected, amount, noise * scale / np.abs(half * gain), blur)


def _blurred(image: Image, sigma: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _mean_around(image: Image, side_px: float) -> Image:
    """Mean over three checkers."""
    size = 2 * int(np.ceil(1.5 * side_px)) + 1
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (size, size)), dtype=np.float32)


def _masked_blur(image: Image, mask: NDArray[np.bool_]) -> Image:
    weight = mask.astype(np.float32)
    total = _blurred(image * weight, SMOOTHING_PX)
    return np.asarray(total / np.maximum(_blurred(weight, SMOOTHING_PX), 0.1), dtype=np.float32)


@dataclass(frozen=True)
class _Samples:
    """Pixels (n,) that determine the light, and the polynomials (n, m) of their places."""

    y: NDArray[np.intp]
    x: NDArray[np.intp]
    terms: NDArray[np.float64]

    @classmethod
    def from_trusted(cls, trusted: NDArray[np.bool_]) -> _Samples:
        y, x = np.nonzero(trusted)
        step = max(1, len(y) // LIGHT_SAMPLES)
        y, x = y[::step], x[::step]
        axes = [np.linspace(-1, 1, count) for count in trusted.shape]
        terms = [axes[1][x] ** p * axes[0][y] ** q for p, q in _powers()]
        return cls(y, x, np.stack(terms, axis=1))

    def fit(self, grey: Image, expected: Image) -> tuple[NDArray[np.float64], float]:
        """Coefficients (2, m) of middle grey and half the contrast, and the mean misfit."""
        wanted = grey[self.y, self.x].astype(np.float64)
        by_print = expected[self.y, self.x].astype(np.float64)
        design = np.concatenate([self.terms, self.terms * by_print[:, None]], axis=1)
        normal = design.T @ design + 1e-6 * len(wanted) * np.eye(design.shape[1])
        found = np.linalg.solve(normal, design.T @ wanted)
        misfit = float(np.abs(wanted - design @ found).mean())
        return found.reshape(2, -1), misfit


def _powers() -> list[tuple[int, int]]:
    return [(p, q) for p in range(LIGHT_DEGREE + 1) for q in range(LIGHT_DEGREE + 1 - p)]


def _light(grey: Image, expected: Image, samples: _Samples) -> tuple[Image, Image] | None:
    """Middle grey and half the contrast over the whole image; None where there is no contrast."""
    found, _ = samples.fit(grey, expected)
    typical = float(np.median(samples.terms @ found[1]))
    if abs(typical) < LEAST_GREY:
        return None
    order = np.arange(LIGHT_DEGREE + 1)
    rows, cols = (np.linspace(-1, 1, count)[:, None] ** order for count in grey.shape)
    images = []
    for part in found:
        square = np.zeros((LIGHT_DEGREE + 1, LIGHT_DEGREE + 1))
        for (p, q), value in zip(_powers(), part, strict=True):
            square[q, p] = value
        images.append(np.asarray(rows @ square @ cols.T, dtype=np.float32))
    # Of the typical sign everywhere, and never near zero.
    sign = np.float32(np.sign(typical))
    least = np.float32(LEAST_CONTRAST * abs(typical))
    return images[0], sign * np.maximum(sign * images[1], least)


def _expected(
    seen: Image, pictures: list[Image], trusted: NDArray[np.bool_], setting: tuple[int, float]
) -> tuple[Image, Image]:
    """The print blurred as each part of the image is, and that blur; setting: blur, side px."""
    best, side_px = setting
    weight = trusted.astype(np.float32)
    least = np.full(seen.shape, np.inf, dtype=np.float32)
    expected, blur = np.zeros_like(seen), np.zeros_like(seen)
    for index in range(max(0, best - LOCAL_STEPS), min(len(BLURS), best + LOCAL_STEPS + 1)):
        picture = pictures[index]
        error = _mean_around(np.abs(seen - picture) * weight, side_px)
        better = error < least
        np.copyto(least, error, where=better)
        np.copyto(expected, picture, where=better)
        np.copyto(blur, np.float32(BLURS[index]), where=better)
    return expected, blur


def _without_local_light(
    seen: Image, expected: Image, trusted: NDArray[np.bool_], side_px: float
) -> tuple[Image, Image]:
    """What is left of an image after light and contrast of each neighbourhood, and the contrast."""
    weight = trusted.astype(np.float32)
    count = np.maximum(_mean_around(weight, side_px), 1e-3)
    mean_e = _mean_around(weight * expected, side_px) / count
    mean_s = _mean_around(weight * seen, side_px) / count
    product = _mean_around(weight * expected * seen, side_px) / count - mean_e * mean_s
    square = _mean_around(weight * expected**2, side_px) / count - mean_e**2
    # Drawn towards 1 where a neighbourhood shows little.
    gain = np.clip((product + 0.05) / (square + 0.05), 0.5, 2.0)
    rest = seen - mean_s - gain * (expected - mean_e)
    return np.asarray(rest / gain, dtype=np.float32), np.asarray(gain, dtype=np.float32)


# Where the print lies in an image: a smooth map from grid numbers to pixels, and its inverse.


@dataclass(frozen=True)
class SmoothLattice:
    """A smooth map from grid numbers (i, j) to pixels that damaged corners do not pull along.

    homography (3, 3): from (j, i, 1), what a flat print would show.  The rest is a spline; rows,
    cols: its knots and degree per direction; coefficients (m, n, 2) px; deviation_px: typical
    distance of a measured corner from the map, and uncertainty_px: what that makes of the map,
    standard deviations per coordinate.
    """

    homography: NDArray[np.float64]
    rows: tuple[NDArray[np.float64], int]
    cols: tuple[NDArray[np.float64], int]
    coefficients: NDArray[np.float64]
    deviation_px: float
    uncertainty_px: float

    @classmethod
    def through(cls, corners: NDArray[np.float64]) -> SmoothLattice:
        """Robust least squares through corners (rows, cols, 2) px; NaN where not measured."""
        rows, cols = (_knots(count) for count in corners.shape[:2])
        basis_i = _basis(rows, np.arange(corners.shape[0], dtype=np.float64))
        basis_j = _basis(cols, np.arange(corners.shape[1], dtype=np.float64))
        known = np.isfinite(corners[..., 0])
        i, j = np.nonzero(known)
        size = basis_i.shape[1], basis_j.shape[1]
        design = (basis_i[i][:, :, None] * basis_j[j][:, None, :]).reshape(len(i), -1)
        homography = _homography(i, j, corners[known])
        target = corners[known] - _flat(homography, i.astype(float), j.astype(float))
        penalty = SMOOTHNESS * _roughness(*size)
        weight, solution, typical = np.ones(len(i)), np.zeros((design.shape[1], 2)), 0.0
        for _ in range(ROBUST_ROUNDS):
            weighted = design * weight[:, None]
            solution = np.linalg.solve(design.T @ weighted + penalty, weighted.T @ target)
            distance = np.linalg.norm(target - design @ solution, axis=1)
            # Median of the length of a two-dimensional normal deviate: 1.177 standard deviations.
            typical = max(float(np.median(distance)) / 1.177, LEAST_DEVIATION_PX)
            weight = 1 / (1 + (distance / (HALF_WEIGHT * typical)) ** 2) ** 2
        # Each coefficient takes its share of the corners' scatter into the map.
        share = min(0.9, design.shape[1] / len(i))
        uncertainty = typical * float(np.sqrt(share / (1 - share)))
        return cls(homography, rows, cols, solution.reshape(*size, 2), typical, uncertainty)

    def at(self, i: NDArray[np.float64], j: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (m, n, 2) at all pairs of rows i (m,) and columns j (n,), fractional or not."""
        basis_i, basis_j = _basis(self.rows, i), _basis(self.cols, j)
        by_column = np.tensordot(basis_i, self.coefficients, axes=(1, 0))
        rest = np.tensordot(by_column, basis_j, axes=(1, 1)).swapaxes(1, 2)
        return np.asarray(_flat(self.homography, i[:, None], j[None, :]) + rest)


@dataclass(frozen=True)
class PrintPlaces:
    """Each pixel's place on the print.

    number (H, W, 2): row and column, corner (i, j) at (i, j), NaN beside the print.
    checker (H, W): +1 and -1 on checkers of either colour, +1 where floor(i) + floor(j) is even;
    what lies between is the share of either colour in a pixel on an edge.
    """

    number: NDArray[np.float32]
    checker: NDArray[np.float32]


def places_in_image(
    lattice: SmoothLattice, corners: tuple[int, int], shape: tuple[int, int]
) -> PrintPlaces:
    """Places on the print, with its outermost checkers, of the pixels of an image (H, W)."""
    first = -1.0
    i, j = (first + np.arange((count + 1) * PIECES + 1) / PIECES for count in corners)
    number = np.full((*shape, 2), np.nan, dtype=np.float32)
    checker = np.zeros(shape, dtype=np.float32)
    _fill_places(lattice.at(i, j), first, number, checker)
    return PrintPlaces(number, checker)


def _homography(
    i: NDArray[np.intp], j: NDArray[np.intp], corners: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The homography closest to corners (n, 2) px; what damaged ones do to it the spline mends."""
    found, _ = cv2.findHomography(np.stack([j, i], axis=1).astype(np.float64), corners)
    if found is None:
        found = np.diag([0.0, 0.0, 1.0])
    return np.asarray(found, dtype=np.float64)


def _flat(
    homography: NDArray[np.float64], i: NDArray[np.float64], j: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels (..., 2) of grid numbers by the homography."""
    (a, b, c), (d, e, f), (g, h, k) = homography
    depth = g * j + h * i + k
    return np.stack([(a * j + b * i + c) / depth, (d * j + e * i + f) / depth], axis=-1)


def _knots(count: int) -> tuple[NDArray[np.float64], int]:
    degree = int(np.clip(count - 2, 1, 3))
    spans = int(np.clip(round((count - 1) / CHECKERS_PER_KNOT), 1, MOST_SPANS))
    spans = max(1, min(spans, count - 1 - degree))
    # Evenly spaced beyond the ends, too: differences of the coefficients are those of the curve.
    numbers = np.arange(-degree, spans + degree + 1, dtype=np.float64)
    return numbers * ((count - 1) / spans), degree


def _basis(axis: tuple[NDArray[np.float64], int], x: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.interpolate import BSpline  # long to import for what is seldom done

    knots, degree = axis
    count = len(knots) - degree - 1
    spline = BSpline(knots, np.eye(count), degree, extrapolate=True)
    return np.asarray(spline(x))


def _roughness(rows: int, cols: int) -> NDArray[np.float64]:
    """Squared third differences of (rows, cols) coefficients along both directions."""
    parts = []
    for count in (rows, cols):
        difference = np.diff(np.eye(count), n=min(3, count - 1), axis=0)
        parts.append(difference.T @ difference)
    return np.kron(parts[0], np.eye(cols)) + np.kron(np.eye(rows), parts[1])


@kernel
def _fill_places(
    nodes: NDArray[np.float64],
    first: float,
    number: NDArray[np.float32],
    checker: NDArray[np.float32],
) -> None:
    """Fill number and checker from the map's pixels at nodes (m, n, 2), 1 / PIECES apart."""
    height, width = checker.shape
    for a in range(nodes.shape[0] - 1):
        for b in range(nodes.shape[1] - 1):
            x0, y0 = nodes[a, b, 0], nodes[a, b, 1]
            x1, y1 = nodes[a + 1, b, 0], nodes[a + 1, b, 1]
            x2, y2 = nodes[a, b + 1, 0], nodes[a, b + 1, 1]
            x3, y3 = nodes[a + 1, b + 1, 0], nodes[a + 1, b + 1, 1]
            left, right = min(x0, x1, x2, x3), max(x0, x1, x2, x3)
            top, bottom = min(y0, y1, y2, y3), max(y0, y1, y2, y3)
            if not (right - left < width and bottom - top < height):
                continue
            twist_x, twist_y = x3 - x1 - x2 + x0, y3 - y1 - y2 + y0
            for y in range(max(0, int(np.ceil(top))), min(height - 1, int(bottom)) + 1):
                for x in range(max(0, int(np.ceil(left))), min(width - 1, int(right)) + 1):
                    s = t = 0.5
                    det = ix = iy = jx = jy = 0.0
                    for _ in range(3):
                        ix, iy = x1 - x0 + t * twist_x, y1 - y0 + t * twist_y
                        jx, jy = x2 - x0 + s * twist_x, y2 - y0 + s * twist_y
                        rx = x - x0 - s * (x1 - x0) - t * jx
                        ry = y - y0 - s * (y1 - y0) - t * jy
                        det = ix * jy - iy * jx
                        if det == 0.0:
                            break
                        s += (rx * jy - ry * jx) / det
                        t += (ix * ry - iy * rx) / det
                    if det == 0.0 or not (-1e-6 <= s <= 1 + 1e-6 and -1e-6 <= t <= 1 + 1e-6):
                        continue
                    # Distance of the gridlines, px, of rows and of columns.
                    to_row = PIECES * abs(det) / np.sqrt(jx * jx + jy * jy)
                    to_col = PIECES * abs(det) / np.sqrt(ix * ix + iy * iy)
                    i, j = first + (a + s) / PIECES, first + (b + t) / PIECES
                    row, col = np.round(i), np.round(j)
                    number[y, x, 0], number[y, x, 1] = i, j
                    ramp = min(1.0, max(-1.0, 2 * (i - row) * to_row))
                    ramp *= min(1.0, max(-1.0, 2 * (j - col) * to_col))
                    checker[y, x] = ramp if int(row + col) % 2 == 0 else -ramp


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
        return text


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
    on_skin = usable & (expected > ON_SKIN)
    glare = _glare(amount - (1 - expected), GLARE + noise, on_skin, side_px)
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
    typical = 1.4826 * float(np.median(np.abs(amount[edge] / gradient[edge])))
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
    return np.asarray(away < GLARE_REACH * side_px)


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
