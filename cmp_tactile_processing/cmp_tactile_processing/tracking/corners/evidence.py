"""Evidence in the image for a corner, and for a gridline between two corners.

Samples lie on circles and lines of the lattice, not of the image: a checker seen at an angle is a
square there.  The circular correlation with the ideal corner gives how much of what the ring shows
is a corner, which diagonal is dark, and how the lattice is turned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.image.prepared import inner_sample, sample

# Radii of the two rings in sides of a checker, and samples on each.
RINGS = np.array([0.27, 0.42])
SAMPLES = 16
RING_FIELDS = ("amplitude", "quality", "turn", "mean")
EDGE_FIELDS = ("weakest", "mean")
# Places along an edge, and distance to either side of it, in sides.
ALONG = np.array([0.25, 0.5, 0.75])
ASIDE = 0.22
# Where blur is measured around a corner, in sides along i and j: the four checkers' middles, on
# either side of the four edges, and the corner.  The weights give light less dark, where the dark
# checkers lie at (+, +) and (-, -): across the gridline along i, and along j; of the checkers on
# either diagonal and the corner; and the checkers' mean.
CLOSE, MIDDLE = 0.15, 0.5
_QUADRANTS = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
BLUR_PLACES = np.concatenate(
    [
        _QUADRANTS * (MIDDLE, MIDDLE),
        _QUADRANTS * (MIDDLE, CLOSE),
        _QUADRANTS * (CLOSE, MIDDLE),
        np.zeros((1, 2)),
    ]
)
BLUR_WEIGHTS = np.zeros((len(BLUR_PLACES), 5))
BLUR_WEIGHTS[4:8, 0] = BLUR_WEIGHTS[8:12, 1] = -0.5 * _QUADRANTS.prod(axis=1)
BLUR_WEIGHTS[:2, 2], BLUR_WEIGHTS[2:4, 3], BLUR_WEIGHTS[:4, 4] = -0.5, 0.5, 0.25
BLUR_WEIGHTS[12, 2:4] = 1.0, -1.0
ANGLES = 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES
COSINE, SINE = np.cos(ANGLES), np.sin(ANGLES)
COSINE_2, SINE_2 = np.cos(2 * ANGLES), np.sin(2 * ANGLES)

Float = NDArray[np.float64]
# Where the rim of something that hides the gel crosses a gridline, there is a saddle too.  It is
# weaker or stronger than those around it, or its contours run askew of the gridlines.  Of corners
# in sight, 99.9 % stay within 0.73 to 1.2 of their neighbours' strength, even at noise of 16 grey
# levels or on a worn print, and 99.9 % below a skew of 0.2 (0.48 on the worn print).
WEAKEST_SADDLE, STRONGEST_SADDLE = 0.65, 1.4
LARGEST_SKEW = 0.4
# The rings reach farther than the fit: least share of their variance that is a corner's, and their
# strength relative to the corners around.
LEAST_QUALITY = 0.45
WEAKEST_RING, STRONGEST_RING = 0.6, 1.5
# An edge to a neighbour differs in grey by this share of the corner's amplitude.
LEAST_EDGE = 0.4
# A corner all of whose neighbours are known is no rim's: on a ragged or spotted print it may look
# less like its neighbours.
WEAKEST_ENCLOSED, LEAST_ENCLOSED_QUALITY = 0.35, 0.25


def ring_evidence(
    smooth: NDArray[np.float32],
    position: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Circular correlation around positions (n, 2) px with the ideal corner, (n, 4).

    row_step, col_step (n, 2): px from a corner to the next along i and along j.  Columns are
    RING_FIELDS: amplitude in grey levels, positive where the dark checkers touch along the
    diagonal (-, -) to (+, +); quality, the least share over both rings of the samples' variance
    that the corner explains, 0 to 1 (0.81 for a sharp corner); turn, the lattice's turn against
    the given steps, rad; mean grey level.  NaN where a ring leaves the image.
    """
    evidence = np.empty((len(position), len(RING_FIELDS)))
    _rings(smooth, position, row_step, col_step, evidence)
    return evidence


def edge_evidence(
    smooth: NDArray[np.float32],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    across: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Grey level on the side of `across` less that on the other side, along edges, (n, 2).

    start, end, across (n, 2) px: the edge's corners and the step to the next gridline on one side.
    Columns are EDGE_FIELDS: the difference of least size and the mean of three places between the
    corners; NaN where a sample leaves the image.
    """
    evidence = np.empty((len(start), len(EDGE_FIELDS)))
    _edges(smooth, start, end, across, evidence)
    return evidence


def blur_evidence(
    grey: NDArray[np.uint8], lattice: NDArray[np.float64], even: bool
) -> tuple[float, float]:
    """How sharp the edges of the checkers are, and how much light and dark ones differ.

    lattice (R, C, 2) px, NaN where a corner is missing; even: whether dark checkers touch corner
    (0, 0) along the diagonal (-, -) to (+, +).  Sharpness: close to an edge, the share of the
    difference between the checkers' middles, of the gridlines along i or j where it is less: 1
    where edges are sharp, 0.45 where grey levels are a sine wave.  Contrast: (light - dark) /
    (light + dark) in the checkers' middles, 0 to 1, twice the lesser part of it where light or
    dark ones are nearer to the corners' grey: a smear along a diagonal makes stripes of checkers.
    NaN where no corner has neighbours along i and along j.
    """
    sums = np.zeros(5)
    _sum_blur(grey, lattice, 1.0 if even else -1.0, sums)
    across_i, across_j, one, other, level = sums
    if not level > 0:
        return float("nan"), float("nan")
    sharpness = min(across_i, across_j) / (one + other) if one + other > 0 else 0.0
    return float(sharpness), max(0.0, float(min(one, other) / level))


@kernel
def _sum_blur(
    grey: NDArray[np.uint8], lattice: NDArray[np.float64], sign: float, sums: NDArray[np.float64]
) -> None:
    """Add up over the corners, (5,): difference close to the gridline along i, and along j; what
    the checkers on one diagonal, and on the other, differ from the corner; the checkers' mean grey.
    """
    rows, cols = lattice.shape[:2]
    found, along_i, along_j = np.empty(len(sums)), np.empty(2), np.empty(2)
    for i in range(rows):
        for j in range(cols):
            _set_step(lattice, i, j, 0, along_i)
            _set_step(lattice, i, j, 1, along_j)
            found[:] = 0.0
            for k in range(len(BLUR_PLACES)):
                a, b = BLUR_PLACES[k, 0], BLUR_PLACES[k, 1]
                x = lattice[i, j, 0] + a * along_i[0] + b * along_j[0]
                y = lattice[i, j, 1] + a * along_i[1] + b * along_j[1]
                level = sample(grey, x, y)
                for m in range(len(sums)):
                    found[m] += level * BLUR_WEIGHTS[k, m]
            if np.isnan(found[0]):
                continue
            turned = sign if (i + j) % 2 == 0 else -sign
            for m in range(len(sums) - 1):
                sums[m] += turned * found[m]
            sums[-1] += found[-1]


@kernel_part
def _set_step(
    lattice: NDArray[np.float64], i: int, j: int, axis: int, step: NDArray[np.float64]
) -> None:
    """The way to the next corner along an axis, (2,) px; NaN where neither neighbour is known."""
    di, dj = (1, 0) if axis == 0 else (0, 1)
    count = 0
    step[:] = 0.0
    for side in (-1, 1):
        k, m = i + side * di, j + side * dj
        inside = 0 <= k < lattice.shape[0] and 0 <= m < lattice.shape[1]
        if inside and not np.isnan(lattice[k, m, 0]):
            for d in range(2):
                step[d] += side * (lattice[k, m, d] - lattice[i, j, d])
            count += 1
    for d in range(2):
        step[d] = step[d] / count if count else np.nan


@kernel
def _rings(
    smooth: NDArray[np.float32],
    position: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
    evidence: NDArray[np.float64],
) -> None:
    for n in range(len(position)):
        quality, sum_cos, sum_sin, total = 1.0, 0.0, 0.0, 0.0
        inside = _is_ring_inside(smooth, position[n], row_step[n], col_step[n])
        for radius in RINGS:
            plain = squares = cosine = sine = 0.0
            for k in range(SAMPLES):
                a, b = radius * COSINE[k], radius * SINE[k]
                x = position[n, 0] + a * row_step[n, 0] + b * col_step[n, 0]
                y = position[n, 1] + a * row_step[n, 1] + b * col_step[n, 1]
                value = inner_sample(smooth, x, y) if inside else sample(smooth, x, y)
                plain += value
                squares += value * value
                cosine += value * COSINE_2[k]
                sine += value * SINE_2[k]
            variance = squares - plain * plain / SAMPLES
            explained = (cosine * cosine + sine * sine) * 2.0 / SAMPLES
            if not variance > 0.0:
                quality = 0.0 if variance == 0.0 else np.nan
            else:
                quality = min(quality, explained / variance)
            sum_cos += cosine
            sum_sin += sine
            total += plain
        count = SAMPLES * len(RINGS)
        strength = 2.0 * np.sqrt(sum_cos**2 + sum_sin**2) / count
        dark_along = sum_sin < 0.0
        evidence[n, 0] = strength if dark_along else -strength
        evidence[n, 1] = np.nan if np.isnan(total) else quality
        sign = -1.0 if dark_along else 1.0
        # The pattern turned by t is sign * sin(2 (angle - t)).
        evidence[n, 2] = 0.5 * np.arctan2(-sign * sum_cos, sign * sum_sin)
        evidence[n, 3] = total / count


@kernel
def _edges(
    smooth: NDArray[np.float32],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    across: NDArray[np.float64],
    evidence: NDArray[np.float64],
) -> None:
    for n in range(len(start)):
        mean, weakest = 0.0, np.inf
        for t in ALONG:
            x = start[n, 0] + t * (end[n, 0] - start[n, 0])
            y = start[n, 1] + t * (end[n, 1] - start[n, 1])
            dx, dy = ASIDE * across[n, 0], ASIDE * across[n, 1]
            step = sample(smooth, x + dx, y + dy) - sample(smooth, x - dx, y - dy)
            mean += step / len(ALONG)
            if not abs(step) >= abs(weakest):
                weakest = step
        evidence[n, 0], evidence[n, 1] = weakest, mean


@kernel_part
def _is_ring_inside(
    image: NDArray[np.float32],
    position: NDArray[np.float64],
    row_step: NDArray[np.float64],
    col_step: NDArray[np.float64],
) -> bool:
    """Whether no sample of a ring can leave the image."""
    height, width = image.shape
    right = RINGS[-1] * (abs(row_step[0]) + abs(col_step[0]))
    down = RINGS[-1] * (abs(row_step[1]) + abs(col_step[1]))
    x, y = position[0], position[1]
    return bool(
        x - right >= 0.0 and y - down >= 0.0 and x + right < width - 1 and y + down < height - 1
    )


# Whether fitted corners look like those around them: bends, rings and edges, compared.


def find_edges(
    smooth: NDArray[np.float32],
    position: Float,
    steps: tuple[Float, Float],
    sign: Float,
    amplitude: Float,
) -> NDArray[np.bool_]:
    """Whether at least half of the edges to known neighbours, and one, are there, (rows, cols).

    position (rows, cols, 2) px; steps: along i and along j, (rows, cols, 2) px each; sign (rows,
    cols): of corners as they should be; amplitude (rows, cols): of the rings, times the sign.
    """
    rows, cols = amplitude.shape
    ends = np.empty((3, 2 * rows * cols - rows - cols, 2))
    _set_edges(position, *steps, ends)
    has_edges = np.empty((rows, cols), dtype=np.bool_)
    _count_edges(edge_evidence(smooth, *ends), sign, amplitude, has_edges)
    return has_edges


@kernel
def _set_edges(position: Float, row_step: Float, col_step: Float, ends: Float) -> None:
    """Start, end and the step across (3, m, 2) of all edges along i, then of those along j."""
    count = 0
    for di, dj, across in ((1, 0, col_step), (0, 1, row_step)):
        for i in range(position.shape[0] - di):
            for j in range(position.shape[1] - dj):
                for d in range(2):
                    ends[0, count, d] = position[i, j, d]
                    ends[1, count, d] = position[i + di, j + dj, d]
                    ends[2, count, d] = across[i, j, d]
                count += 1


@kernel
def _count_edges(edges: Float, sign: Float, amplitude: Float, has_edges: NDArray[np.bool_]) -> None:
    """Judge corners by their edges (m, 2) in the order of `_set_edges`."""
    rows, cols = amplitude.shape
    known, seen = np.zeros((2, rows, cols), dtype=np.int64)
    count = 0
    for di, dj in ((1, 0), (0, 1)):
        for i in range(rows - di):
            for j in range(cols - dj):
                edge = edges[count, 1]
                count += 1
                if not np.isfinite(edge):
                    continue
                # Beyond an even corner the checker at (+, +) is dark.
                least = LEAST_EDGE * (amplitude[i, j] + amplitude[i + di, j + dj]) / 2
                is_edge = -sign[i, j] * edge > least
                known[i, j] += 1
                known[i + di, j + dj] += 1
                seen[i, j] += is_edge
                seen[i + di, j + dj] += is_edge
    for i in range(rows):
        for j in range(cols):
            has_edges[i, j] = seen[i, j] >= 1 and 2 * seen[i, j] >= known[i, j]


@kernel_part
def _curvature(hessian: Float, x: float, y: float) -> float:
    """Second derivative along a direction."""
    bend = hessian[0] * x * x + 2 * hessian[1] * x * y + hessian[2] * y * y
    return float(bend / (x * x + y * y))


@kernel
def measure_bends(
    hessian: Float, row_step: Float, col_step: Float, sign: Float, bends: Float
) -> None:
    """Fill bends (2, rows, cols): down along the dark checkers' diagonal, and along gridlines.

    hessian (rows * cols, 3): xx, xy, yy; row_step, col_step (rows, cols, 2) px; sign (rows, cols)
    of corners as they should be.
    """
    rows, cols = sign.shape
    for i in range(rows):
        for j in range(cols):
            here = hessian[i * cols + j]
            a, b = row_step[i, j, 0], row_step[i, j, 1]
            c, d = col_step[i, j, 0], col_step[i, j, 1]
            down = _curvature(here, a - c, b - d) - _curvature(here, a + c, b + d)
            bends[0, i, j] = sign[i, j] * down
            bends[1, i, j] = max(abs(_curvature(here, a, b)), abs(_curvature(here, c, d)))


@kernel
def compare(
    bends: Float,
    rings: tuple[Float, Float],
    around: tuple[Float, Float],
    alike: NDArray[np.bool_],
    similar: NDArray[np.bool_],
) -> None:
    """Fill in which corners (rows, cols) look like those around them, or at least similar.

    bends: see `measure_bends`; rings: amplitude, positive as it should be, and quality; around:
    usual bend and ring amplitude there.
    """
    strength, usual, ring, usual_ring = bends[0], around[0], rings[0], around[1]
    for i in range(alike.shape[0]):
        for j in range(alike.shape[1]):
            relative, relative_ring = strength[i, j] / usual[i, j], ring[i, j] / usual_ring[i, j]
            quality = rings[1][i, j]
            alike[i, j] = (
                WEAKEST_SADDLE < relative < STRONGEST_SADDLE
                and WEAKEST_RING < relative_ring < STRONGEST_RING
                and quality > LEAST_QUALITY
                and bends[1, i, j] < LARGEST_SKEW * strength[i, j]
            )
            similar[i, j] = relative_ring > WEAKEST_ENCLOSED and quality > LEAST_ENCLOSED_QUALITY
