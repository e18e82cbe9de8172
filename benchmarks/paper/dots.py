"""Settings of the dot methods (DMP).

They were chosen on contacts that no experiment uses. The reasons below refer to the tables of
benchmarks/results/paper_dot_tuning.md, which also says how they were measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmp_tactile_processing.image.prepared import ImpulseFilter, noise_of
from cmp_tactile_processing.tracking.detector import NominalGrid
from paper.sequence import DOT_DIAMETER

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DotParameters:
    """Settings of all dot methods, and of each method.

    Lengths are shares of the pitch as the view shows it, darkness of the dots' own.
    diameter: of the printed dots.
    threshold: darkness from which a pixel counts for the centre.  window: radius around the centre
    within which pixels count, in radii of a dot.
    curvature: whether centres are corrected for the curvature of the measured grid, or only for
    that of the nominal one, which is perspective and the gel's shape at rest.
    least_response: of the matched filter, as a share of a typical dot's.
    least_area, most_area: of a typical dot's; most_elongation: longer over shorter axis, after the
    foreshortening is taken out; most_residual: RMS distance of the outline from an ellipse, in
    radii.  A dot outside of these is hidden in part.
    nearest_gate, assignment_gate, grid_gate, recovery_gate: how far a dot may lie from where it is
    looked for.
    flow_window: side of the optical flow's window, in pitches; flow_levels: halvings of the image;
    flow_return: how far the flow back may miss the start, px.
    """

    diameter: float = DOT_DIAMETER
    # Skin that weighs adds noise, a dot's rim that does not weigh lets pixels draw the centre.
    threshold: float = 0.05
    window: float = 1.6
    # The neighbours show about two fifths of what a contact does to the centres.
    curvature: bool = True
    # Noise of a quarter of the contrast answers with 0.23 at most, in 450 x 450 px.
    least_response: float = 0.4
    # Contacts change areas by less than half and stretch by less than these.
    least_area: float = 0.55
    most_area: float = 1.8
    most_elongation: float = 2.0
    most_residual: float = 0.12
    # More changes nothing but which markers go wrong; less loses dots that move slowly.
    nearest_gate: float = 0.9
    # Less loses what leaps; more changes nothing.
    assignment_gate: float = 3.0
    # Neighbours are distinguished up to half a pitch; all values up to that do as well.
    grid_gate: float = 0.45
    recovery_gate: float = 0.35
    # As good as any, but three halvings blur dots away.
    flow_window: float = 1.2
    flow_levels: int = 2
    flow_return: float = 1.0


def centroid_bias(grid: Array, radius: float) -> Array:
    """Centroid of a disc's picture minus picture of its centre, (rows, cols, 2) px.

    grid (rows, cols, 2) px: pictures q(i, j) of the markers; radius: of the discs, in pitches.
    To the second order of the radius: r^2 / 8 laplacian(q) + r^2 / 4 (grad J . grad) q / J, with J
    the area that a pitch by a pitch has in the picture.  That covers perspective, the curvature of
    the gel and any deformation that the neighbours show; NaN where one of them is missing.
    """
    by_i, by_j = _slopes(grid)
    laplacian = _bends(grid, 0) + _bends(grid, 1)
    area = by_j[..., 0] * by_i[..., 1] - by_j[..., 1] * by_i[..., 0]
    slope_i, slope_j = _slopes(area[..., None])
    with np.errstate(divide="ignore", invalid="ignore"):
        drift = (slope_i * by_i + slope_j * by_j) / area[..., None]
    return np.asarray(radius**2 * (laplacian / 8 + drift / 4))


def _slopes(values: Array) -> tuple[Array, Array]:
    return np.gradient(values, axis=0), np.gradient(values, axis=1)


def _bends(values: Array, axis: int) -> Array:
    """Second differences; those of the borders are their neighbours'."""
    inner = np.diff(values, 2, axis=axis)
    width = [(0, 0)] * values.ndim
    width[axis] = (1, 1)
    return np.pad(inner, width, mode="edge")


# Passes in which the window moves to the centre that the last one found.
PASSES = 4
# The window's rim fades over this share of its radius, so that no pixel enters it at once.
FADE = 0.25
# Directions in which a dot's edge is looked for, and how far, in radii.
DIRECTIONS = 24
REACH = 1.9
STEPS = 40
# Darkness at the edge of a dot.
EDGE = 0.5


@dataclass(frozen=True)
class Outlines:
    """Ellipses through the edges of N dots.

    area (N,) px^2; elongation (N,): longer over shorter axis where the nominal
    foreshortening is taken out; residual (N,): RMS distance of the edge from the ellipse, in mean
    radii.  NaN where the edge is not closed.
    """

    area: Array
    elongation: Array
    residual: Array


def peaks(response: NDArray[np.float32], at: NDArray[np.intp]) -> Array:
    """Tops (N, 2) px of the quadratic surfaces through 3 x 3 pixels around at (N, 2), as (x, y)."""
    x, y = at.T
    z = [[response[y + dy, x + dx].astype(np.float64) for dx in (-1, 0, 1)] for dy in (-1, 0, 1)]
    slope_x = sum(row[2] - row[0] for row in z) / 6
    slope_y = sum(z[2][k] - z[0][k] for k in range(3)) / 6
    bend_x = sum(row[2] - 2 * row[1] + row[0] for row in z) / 3
    bend_y = sum(z[2][k] - 2 * z[1][k] + z[0][k] for k in range(3)) / 3
    twist = (z[2][2] - z[2][0] - z[0][2] + z[0][0]) / 4
    determinant = bend_x * bend_y - twist**2
    with np.errstate(divide="ignore", invalid="ignore"):
        off_x = (twist * slope_y - bend_y * slope_x) / determinant
        off_y = (twist * slope_x - bend_x * slope_y) / determinant
    off = np.stack([off_x, off_y], axis=-1)
    good = (determinant > 0) & (np.abs(off) < 1).all(axis=1)
    return np.asarray(at + np.where(good[:, None], off, 0.0), dtype=np.float64)


def outlines(darkness: NDArray[np.float32], centre: Array, to_radii: Array) -> Outlines:
    """Edges of dots around centres (N, 2) px where the darkness falls to half, and ellipses."""
    from_radii = np.linalg.inv(to_radii)
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rays = np.einsum("nij,kj->nki", from_radii, circle)
    reach = _edges(darkness, np.ascontiguousarray(centre), np.ascontiguousarray(rays))
    # In radii of the undeformed dot, so that all are of one size.
    edge = reach[..., None] * circle
    axes, residual = _ellipses(edge)
    scale = np.abs(np.linalg.det(from_radii))
    return Outlines(
        area=np.pi * axes[:, 0] * axes[:, 1] * scale,
        elongation=axes[:, 1] / axes[:, 0],
        residual=residual,
    )


@njit(cache=True, nogil=True)
def centroids(
    darkness: NDArray[np.float32], start: Array, to_radii: Array, threshold: float, window: float
) -> Array:
    """Darkness-weighted centroids (N, 2) px; NaN where nothing dark is.

    darkness (H, W): 0 for skin, 1 for ink.  start (N, 2) px.  to_radii (N, 2, 2): from px to radii
    of a dot as it is foreshortened there.  threshold: what is subtracted from the darkness before
    it weighs.  window: radius of what counts, in radii.
    """
    height, width = darkness.shape
    found = np.empty_like(start)
    for n in range(len(start)):
        x0, y0 = start[n]
        a, b, c, d = to_radii[n, 0, 0], to_radii[n, 0, 1], to_radii[n, 1, 0], to_radii[n, 1, 1]
        determinant = abs(a * d - b * c)
        # Half the sides of the box around the window.
        reach_x = window * np.sqrt(b * b + d * d) / determinant
        reach_y = window * np.sqrt(a * a + c * c) / determinant
        for _ in range(PASSES):
            total, sum_x, sum_y = 0.0, 0.0, 0.0
            for y in range(max(int(y0 - reach_y), 0), min(int(y0 + reach_y) + 2, height)):
                for x in range(max(int(x0 - reach_x), 0), min(int(x0 + reach_x) + 2, width)):
                    u, v = a * (x - x0) + b * (y - y0), c * (x - x0) + d * (y - y0)
                    inside = (window - np.sqrt(u * u + v * v)) / (FADE * window)
                    if inside <= 0:
                        continue
                    weight = min(inside, 1.0) * max(darkness[y, x] - threshold, 0.0)
                    total += weight
                    sum_x += weight * x
                    sum_y += weight * y
            if total <= 0:
                x0, y0 = np.nan, np.nan
                break
            x0, y0 = sum_x / total, sum_y / total
        found[n, 0], found[n, 1] = x0, y0
    return found


@njit(cache=True, nogil=True)
def _edges(darkness: NDArray[np.float32], centre: Array, rays: Array) -> Array:
    """How far along each ray (N, K, 2) px the darkness first falls to EDGE; NaN if nowhere."""
    height, width = darkness.shape
    found = np.full(rays.shape[:2], np.nan)
    for n in range(len(centre)):
        for k in range(rays.shape[1]):
            last = 2.0
            for step in range(STEPS + 1):
                reach = 0.2 + step * (REACH - 0.2) / STEPS
                x, y = centre[n, 0] + reach * rays[n, k, 0], centre[n, 1] + reach * rays[n, k, 1]
                if not (0 <= x < width - 1 and 0 <= y < height - 1):
                    break
                col, row = int(x), int(y)
                u, v = x - col, y - row
                upper = darkness[row, col] * (1 - u) + darkness[row, col + 1] * u
                lower = darkness[row + 1, col] * (1 - u) + darkness[row + 1, col + 1] * u
                value = upper * (1 - v) + lower * v
                if value < EDGE:
                    if step > 0:
                        back = (EDGE - value) / (last - value)
                        found[n, k] = reach - back * (REACH - 0.2) / STEPS
                    break
                last = value
    return found


def _ellipses(edge: Array) -> tuple[Array, Array]:
    """Half axes (N, 2), shorter first, and residual (N,) of points (N, K, 2).

    Conics a x^2 + b x y + c y^2 + d x + e y = 1, which do for outlines around the origin.
    """
    axes, residual = np.full((len(edge), 2), np.nan), np.full(len(edge), np.nan)
    closed = np.asarray(np.isfinite(edge).all(axis=(1, 2)))
    x, y = edge[closed, :, 0], edge[closed, :, 1]
    design = np.stack([x * x, x * y, y * y, x, y], axis=-1)
    transposed = design.swapaxes(1, 2)
    conic = np.linalg.solve(
        transposed @ design + 1e-12 * np.eye(5), transposed.sum(axis=2)[..., None]
    )[..., 0]
    matrix = np.empty((len(conic), 2, 2))
    matrix[:, 0, 0], matrix[:, 1, 1] = conic[:, 0], conic[:, 2]
    matrix[:, 0, 1] = matrix[:, 1, 0] = conic[:, 1] / 2
    good = np.linalg.det(matrix) > 1e-9
    closed[closed] = good
    matrix, conic, points = matrix[good], conic[good], edge[closed]
    middle = -np.linalg.solve(matrix, conic[:, 3:, None])[..., 0] / 2
    level = 1 + np.einsum("ni,nij,nj->n", middle, matrix, middle)
    values, vectors = np.linalg.eigh(matrix)
    with np.errstate(invalid="ignore"):
        half = np.sqrt(level[:, None] / values)
    along = np.einsum("nij,nki->nkj", vectors, points - middle[:, None]) / half[:, None]
    axes[closed] = half[:, ::-1]
    residual[closed] = np.sqrt(np.mean((np.linalg.norm(along, axis=-1) - 1) ** 2, axis=1))
    return axes, residual


# Percentiles of the grey values that ink and skin certainly reach.
INK, SKIN = 2.0, 80.0
# Pixels darker than the median around them by more than this share are not skin.
NOT_SKIN = 0.3
# Standard deviation of the matched filter, in radii of a dot, and of what it subtracts: a
# Laplacian of this width answers a disc most.
MATCHED, SURROUND = 0.7, 1.6
# Outlines are taken from an image smoothed by so many radii per noise above a little, up to CALM.
CALM_PER_NOISE, LITTLE_NOISE, CALM = 4.0, 0.03, 0.45
# What salt and pepper leaves behind does as much harm as this noise, per squared share of pixels.
LIKE_NOISE = 2.5
# Smallest distance of two dots, as a share of the pitch.
APART = 0.4


@dataclass(frozen=True)
class DotImage:
    """A view image prepared.  grey (H, W) uint8 without salt and pepper; darkness (H, W) float32:
    0 where the skin is, 1 where the ink is, in any light; noise: of the image, as a share of the
    contrast of ink and skin."""

    grey: NDArray[np.uint8]
    darkness: NDArray[np.float32]
    noise: float


class DotDetector:
    """Finds the dots of images of one size.

    nominal: in pixels of these images; shape: (height, width), px.
    """

    def __init__(
        self, nominal: NominalGrid, shape: tuple[int, int], parameters: DotParameters
    ) -> None:
        self._nominal, self._parameters = nominal, parameters
        self._radius_px = parameters.diameter * nominal.side_px / 2
        self._impulses = ImpulseFilter(shape, 2 * self._radius_px)
        self._clean = np.empty(shape, np.uint8)

    def prepare(self, grey: NDArray[np.uint8]) -> DotImage:
        """An image (H, W) without salt and pepper, its light divided out."""
        contrast = float(np.diff(np.percentile(grey, (INK, SKIN)))[0])
        self._impulses.apply(grey, contrast, self._clean)
        clean = self._clean
        light = _light(clean, self._nominal.side_px)
        dark = 1 - clean.astype(np.float32) / light
        smooth = _blurred(dark, 0.5 * self._radius_px)
        ink = _ink_darkness(smooth, self._nominal.corners[..., 0].size)
        level = float(np.median(light)) * max(ink, 1e-3)
        replaced = np.count_nonzero(clean != grey) / grey.size
        noise = float(np.hypot(noise_of(clean) / level, LIKE_NOISE * replaced**2))
        return DotImage(clean.copy(), np.asarray(dark / ink), noise)

    def detect(self, image: DotImage) -> Array:
        """Places (N, 2) px of the dots that are seen whole; any number, also none."""
        at, response = self._candidates(image.darkness)
        centre = peaks(response, at)
        to_radii = self._to_radii(centre)
        edge = outlines(self._calm(image), centre, to_radii)
        limits = self._parameters.threshold, self._parameters.window
        centre = centroids(image.darkness, centre, to_radii, *limits)
        whole = self._whole(edge, to_radii) & np.isfinite(centre).all(axis=1)
        return np.asarray(centre[whole])

    def _candidates(
        self, darkness: NDArray[np.float32]
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Pixels (N, 2), as (x, y), where a matched filter answers most, and its answers (H, W)."""
        sigma = MATCHED * self._radius_px
        limited = np.clip(darkness, -0.5, 1.5)
        response = _blurred(limited, sigma) - _blurred(limited, SURROUND * sigma)
        apart = max(int(APART * self._nominal.smallest_side_px), 1)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * apart + 1, 2 * apart + 1))
        top = response >= cv2.dilate(response, disc)
        top[:2], top[-2:], top[:, :2], top[:, -2:] = False, False, False, False
        y, x = np.nonzero(top)
        value = response[y, x]
        count = self._nominal.corners[..., 0].size
        typical = float(np.median(np.sort(value)[-count:])) if len(value) else 0.0
        strong = value > max(self._parameters.least_response * typical, 0.02)
        return np.stack([x[strong], y[strong]], axis=-1), response

    def _calm(self, image: DotImage) -> NDArray[np.float32]:
        """Darkness smooth enough for outlines to be those of the dots, not of the noise."""
        sigma = min(CALM_PER_NOISE * max(image.noise - LITTLE_NOISE, 0.0), CALM) * self._radius_px
        return _blurred(image.darkness, sigma) if sigma > 0 else image.darkness

    def _to_radii(self, q: Array) -> Array:
        """(N, 2, 2): from px to radii of a dot as the nominal projection shows it near q."""
        along_i, along_j = self._nominal.axes_near(q)
        radius = self._parameters.diameter / 2
        return np.asarray(np.linalg.inv(radius * np.stack([along_j, along_i], axis=-1)))

    def _whole(self, edge: Outlines, to_radii: Array) -> NDArray[np.bool_]:
        settings = self._parameters
        area = edge.area * np.abs(np.linalg.det(to_radii))
        area /= np.nanmedian(area) if np.isfinite(area).any() else 1.0
        return np.asarray(
            (area > settings.least_area)
            & (area < settings.most_area)
            & (edge.elongation < settings.most_elongation)
            & (edge.residual < settings.most_residual)
        )


def _blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _light(grey: NDArray[np.uint8], side_px: float) -> NDArray[np.float32]:
    """Grey of the skin around each pixel: the mean of the pixels that are not ink."""
    size = 2 * round(side_px) + 1
    typical = cv2.medianBlur(grey, size).astype(np.float32)
    skin = (grey > (1 - NOT_SKIN) * typical).astype(np.float32)
    share = cv2.blur(skin, (size, size))
    total = cv2.blur(skin * grey, (size, size))
    with np.errstate(divide="ignore", invalid="ignore"):
        light = np.where(share > 0.1, total / share, typical)
    return np.asarray(np.maximum(light, 1.0), dtype=np.float32)


def _ink_darkness(smooth: NDArray[np.float32], count: int) -> float:
    """Typical darkness in the middle of the `count` dots of an image."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    tops = np.sort(smooth[smooth >= cv2.dilate(smooth, disc)])[-count:]
    return max(float(np.median(tops)), 0.02) if len(tops) else 1.0
