"""From what a view sees of a surface to the greys of its pixels.

A cell of pixels far from any change of grey is filled.  In the others a pixel that a change may
cross is the mean of its samples.  Their material points come from the nodes' cubic, or, where that
is not exact enough or the surface folds, from a ray of their own.  A sample is a small square: what
lies beyond the nearest change of grey counts in proportion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_simulation.rendering.ink import InkArrays, Print, ink_at, is_blotted
from cmp_tactile_simulation.rendering.sight import ALIKE_PX, NODE_PX, between, cubic_weights
from cmp_tactile_simulation.rendering.surface import SplineSurface, first_meeting, meet

# Pixels and cells reach farther than half the diagonals of a cell of even pixels, by this factor.
UNEVEN = 1.2
# Where third differences of the nodes are below this, px, the cubic misses by a tenth of that.
EVEN_PX = 0.05
# How far the cubic may miss the surface amid a cell, px, for its samples, and for it to be of use.
MAX_MISS_PX, LOST_PX = 0.01, 1.0
# Nodes this far beyond the block, in pixels, belong to cells beyond it: the mesh ends there.
WELL_BEYOND_PX = 1.6
# Cells of one grey, of the cubic, of the cubic as a guess, and of a folded surface.
ONE_GREY, SMOOTH, SHARP, BROKEN = range(4)


class Picture(NamedTuple):
    """One view in the making.

    nodes, folded: of a `Sight`.  origins, directions, pixel_m: of its `ViewNodes`.
    samples: along each side of a pixel.  fineness: entries of the frame along it.
    height, width: px.  top, left: the view's first entry in the frame.  step: to the next on the
    right, -1 where the frame has the view mirrored.
    """

    nodes: NDArray[np.float64]
    folded: NDArray[np.bool_]
    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    pixel_m: float
    samples: int
    fineness: int
    height: int
    width: int
    top: int
    left: int
    step: int


@kernel_part(forceinline=True)
def _mixed(
    ink: Print,
    strays: NDArray[np.float32] | None,
    blobs: NDArray[np.float64] | None,
    xy: tuple[float, float],
    side: float,
) -> Any:
    """Mean grey of a sample that is a square of that side (m), about a material point."""
    grey, _, other, near = ink_at(ink, strays, blobs, xy[0], xy[1])
    # How much of a square lies beyond a straight line: right for its mean and its spread.
    return grey + (other - grey) * max(0.5 - near / side, 0.0)


@kernel_part(forceinline=True)
def _interpolate_ray(
    picture: Picture, cell: tuple[int, int], place: tuple[float, float], ray: NDArray[np.float64]
) -> None:
    """Origin ray[0] and direction ray[1] at a place (down, right) in a cell, px."""
    down, right = cubic_weights(place[0] / NODE_PX), cubic_weights(place[1] / NODE_PX)
    for c in range(3):
        ray[0, c] = picture.origins[0, 0, c]
        if picture.origins.shape[0] > 1:
            ray[0, c] = between(picture.origins, cell, down, right, c)
        ray[1, c] = between(picture.directions, cell, down, right, c)


@kernel_part(forceinline=True)
def _meet_from(  # noqa: PLR0913, PLR0917 - flat, as the compiler wants it
    surface: SplineSurface,
    picture: Picture,
    cell: tuple[int, int],
    place: tuple[float, float],
    xy: tuple[float, float],
    ray: NDArray[np.float64],
) -> Any:
    """The material point at a place of a cell, or else the guess, and how far that was off, m."""
    _interpolate_ray(picture, cell, place, ray)
    good, x, y, _ = meet(surface, ray[0], ray[1], xy[0], xy[1])
    if not good:
        return xy[0], xy[1], np.inf
    return x, y, np.sqrt((x - xy[0]) ** 2 + (y - xy[1]) ** 2)


@kernel_part
def _is_beside(ink: Print, picture: Picture, cell: tuple[int, int]) -> bool:
    """Whether all nodes of a cell are well beyond the block, or not known: the mesh ends there."""
    for i in range(cell[0], cell[0] + 4):
        for j in range(cell[1], cell[1] + 4):
            x, y = picture.nodes[i, j, 0], picture.nodes[i, j, 1]
            # False where nothing is known.
            if max(abs(x) - ink.half_x, abs(y) - ink.half_y) < WELL_BEYOND_PX * picture.pixel_m:
                return False
    return True


@kernel_part
def _kind(
    surface: SplineSurface,
    ink: Print,
    picture: Picture,
    cell: tuple[int, int],
    ray: NDArray[np.float64],
) -> int:
    """What is to be done about a cell that a change of grey may cross."""
    nodes, half, pixel_m = picture.nodes, cubic_weights(0.5), picture.pixel_m
    x, y = between(nodes, cell, half, half, 0), between(nodes, cell, half, half, 1)
    if np.isnan(x):
        return ONE_GREY if _is_beside(ink, picture, cell) else BROKEN
    if picture.folded[cell]:
        return BROKEN
    if _third_difference(nodes, cell) < EVEN_PX * pixel_m:
        return SMOOTH
    _, _, miss = _meet_from(surface, picture, cell, (NODE_PX / 2, NODE_PX / 2), (x, y), ray)
    if miss < MAX_MISS_PX * pixel_m:
        return SMOOTH
    return SHARP if miss < LOST_PX * pixel_m else BROKEN


@kernel_part(forceinline=True)
def _third_difference(nodes: NDArray[np.float64], cell: tuple[int, int]) -> float:
    """The largest of the material points across a cell, along its sides, m."""
    (i, j), most = cell, 0.0
    for c in range(2):
        for k in range(1, 3):
            a = nodes[i + k, j + 3, c] - nodes[i + k, j, c]
            b = nodes[i + 3, j + k, c] - nodes[i, j + k, c]
            a -= 3 * (nodes[i + k, j + 2, c] - nodes[i + k, j + 1, c])
            b -= 3 * (nodes[i + 2, j + k, c] - nodes[i + 1, j + k, c])
            most = max(most, abs(a), abs(b))
    return most


@kernel_part(forceinline=True)
def _amid(nodes: NDArray[np.float64], cell: tuple[int, int]) -> Any:
    """The middle of a cell's corners, material x and y, and how far its points are from there, m.

    NaN where a corner is not known.
    """
    i, j = cell[0] + 1, cell[1] + 1
    x = (nodes[i, j, 0] + nodes[i, j + 1, 0] + nodes[i + 1, j, 0] + nodes[i + 1, j + 1, 0]) / 4
    y = (nodes[i, j, 1] + nodes[i, j + 1, 1] + nodes[i + 1, j, 1] + nodes[i + 1, j + 1, 1]) / 4
    far2 = 0.0
    for k in range(4):
        dx, dy = nodes[i + k // 2, j + k % 2, 0] - x, nodes[i + k // 2, j + k % 2, 1] - y
        far2 = max(far2, dx * dx + dy * dy)
    return x, y, UNEVEN * np.sqrt(far2)


@kernel_part(forceinline=True)
def _side(nodes: NDArray[np.float64], cell: tuple[int, int]) -> float:
    """Side of a pixel in a cell, m: the root mean square of width and height."""
    i, j = cell
    total = 0.0
    for c in range(2):
        rising = nodes[i + 1, j + 2, c] - nodes[i + 2, j + 1, c]
        falling = nodes[i + 2, j + 2, c] - nodes[i + 1, j + 1, c]
        # Diagonals of a parallelogram: their squares are together those of all four sides.
        total += rising * rising + falling * falling
    return float(np.sqrt(total) / (2 * NODE_PX))


@kernel
def shade(
    surface: SplineSurface,
    ink: InkArrays,
    picture: Picture,
    rows: tuple[int, int],
    frame: NDArray[np.float32],
) -> NDArray[np.intp]:
    """Greys of these rows of cells (first, last + 1) in the frame.

    Returns the cells (k, 2) that are left for `cast`.
    """
    plain, strays, blobs = ink
    clean = InkArrays(plain, strays, None)
    nodes, folded = picture.nodes, picture.folded
    left, lost = np.empty(((rows[1] - rows[0]) * folded.shape[1], 2), np.intp), 0
    room = _Room(_weights(1), _weights(picture.samples), np.empty((2, 4)), np.empty((2, 3)))
    for i in range(rows[0], rows[1]):
        for j in range(folded.shape[1]):
            x, y, far = _amid(nodes, (i, j))
            grey, clear = plain.housing, 0.0
            if not np.isnan(x):
                grey, clear, _, _ = ink_at(plain, strays, blobs, x, y)
            kind = ONE_GREY
            if folded[i, j] or not clear > far:
                kind = _kind(surface, plain, picture, (i, j), room.ray)
            if kind == ONE_GREY:
                v, u = NODE_PX * i, NODE_PX * j
                _fill(picture, (v, v + NODE_PX, u, u + NODE_PX), grey, frame)
            elif kind == BROKEN:
                left[lost, 0], left[lost, 1] = i, j
                lost += 1
            elif is_blotted(plain, blobs, (x, y, far)):
                _shade_cell(surface, ink, picture, (i, j), far, kind == SHARP, room, frame)
            else:
                _shade_cell(surface, clean, picture, (i, j), far, kind == SHARP, room, frame)
    return left[:lost]


class _Room(NamedTuple):
    """Arrays that all cells use.

    of_pixels (NODE_PX, 4), of_samples (NODE_PX samples, 4): cubic weights of their places in a
    cell.  line (2, 4), ray (2, 3): to be written to.
    """

    of_pixels: NDArray[np.float64]
    of_samples: NDArray[np.float64]
    line: NDArray[np.float64]
    ray: NDArray[np.float64]


@kernel_part
def _shade_cell(  # noqa: PLR0913, PLR0917 - flat, as the compiler wants it
    surface: SplineSurface,
    ink: InkArrays,
    picture: Picture,
    cell: tuple[int, int],
    far: float,
    sharp: bool,
    room: _Room,
    frame: NDArray[np.float32],
) -> None:
    """Greys of a cell that a change of grey may cross; far: of `_amid`."""
    (plain, strays, blobs), v, u = ink, NODE_PX * cell[0], NODE_PX * cell[1]
    nodes, count, fine, line = picture.nodes, picture.samples, picture.fineness, room.line
    part, side = count // fine, _side(nodes, cell) / count
    # From a pixel's centre to the far end of its farthest sample.
    reach = far / NODE_PX * (1 - 1 / count) + UNEVEN * side / 2
    for down in range(min(NODE_PX, picture.height - v)):
        for right in range(min(NODE_PX, picture.width - u)):
            _across(nodes, cell, room.of_pixels[down], line)
            x, y = _along(line, room.of_pixels[right])
            grey, clear, _, _ = ink_at(plain, strays, blobs, x, y)
            pixel = v + down, v + down + 1, u + right, u + right + 1
            if clear > reach:
                _fill(picture, pixel, grey, frame)
                continue
            _fill(picture, pixel, 0.0, frame)
            for k in range(count):
                _across(nodes, cell, room.of_samples[down * count + k], line)
                row = picture.top + (v + down) * fine + k // part
                for m in range(count):
                    x, y = _along(line, room.of_samples[right * count + m])
                    if sharp:
                        place = down + (k + 0.5) / count, right + (m + 0.5) / count
                        x, y, _ = _meet_from(surface, picture, cell, place, (x, y), room.ray)
                    grey = _mixed(plain, strays, blobs, (x, y), side)
                    col = picture.left + picture.step * ((u + right) * fine + m // part)
                    frame[row, col] += grey / (part * part)


@kernel_part(forceinline=True)
def _fill(
    picture: Picture, pixels: tuple[int, int, int, int], grey: float, frame: NDArray[np.float32]
) -> None:
    """Give pixels (first row, last + 1, first column, last + 1) one grey."""
    fine, top = picture.fineness, picture.top
    first, last = fine * pixels[2], fine * min(pixels[3], picture.width)
    if picture.step < 0:
        first, last = 1 - last, 1 - first
    for row in range(top + fine * pixels[0], top + fine * min(pixels[1], picture.height)):
        for col in range(picture.left + first, picture.left + last):
            frame[row, col] = grey


@kernel_part
def _weights(count: int) -> NDArray[np.float64]:
    """Cubic weights (NODE_PX count, 4) of the places of `count` samples in each pixel of a cell."""
    weights = np.empty((NODE_PX * count, 4))
    for k in range(len(weights)):
        a, b, c, d = cubic_weights((k + 0.5) / len(weights))
        weights[k, 0], weights[k, 1], weights[k, 2], weights[k, 3] = a, b, c, d
    return weights


@kernel_part(forceinline=True)
def _across(
    nodes: NDArray[np.float64],
    cell: tuple[int, int],
    down: NDArray[np.float64],
    line: NDArray[np.float64],
) -> None:
    """Material x and y where a line across a cell meets its four columns of nodes, line (2, 4)."""
    i, j = cell
    for n in range(4):
        for k in range(2):
            line[k, n] = (
                down[0] * nodes[i, j + n, k]
                + down[1] * nodes[i + 1, j + n, k]
                + down[2] * nodes[i + 2, j + n, k]
                + down[3] * nodes[i + 3, j + n, k]
            )


@kernel_part(forceinline=True)
def _along(line: NDArray[np.float64], w: NDArray[np.float64]) -> Any:
    """Material x and y at a place of a line."""
    x = w[0] * line[0, 0] + w[1] * line[0, 1] + w[2] * line[0, 2] + w[3] * line[0, 3]
    y = w[0] * line[1, 0] + w[1] * line[1, 1] + w[2] * line[1, 2] + w[3] * line[1, 3]
    return x, y


@kernel
def cast(  # noqa: PLR0913, PLR0917 - flat, as the compiler wants it
    surface: SplineSurface,
    ink: InkArrays,
    picture: Picture,
    cells: NDArray[np.intp],
    guesses: tuple[NDArray[np.float64], int],
    frame: NDArray[np.float32],
) -> None:
    """Greys of cells (k, 2) by rays for each sample, where the surface folds or bends sharply.

    guesses: of `Sight.guesses`, and the first row of pixels there.
    """
    (plain, strays, blobs), (near, first) = ink, guesses
    fine, count = picture.fineness, picture.samples
    part, side, alike = count // fine, picture.pixel_m / count, ALIKE_PX * picture.pixel_m
    starts, ray = np.empty((9, 2)), np.empty((2, 3))
    for i, j in cells:
        for v in range(NODE_PX * i, min(NODE_PX * (i + 1), picture.height)):
            for u in range(NODE_PX * j, min(NODE_PX * (j + 1), picture.width)):
                for k in range(9):
                    # The pixel itself first.
                    row, col = v - first + (k // 3 + 1) % 3, u + (k + 1) % 3
                    starts[k, 0], starts[k, 1] = near[row, col, 0], near[row, col, 1]
                _fill(picture, (v, v + 1, u, u + 1), 0.0, frame)
                for k in range(count * count):
                    at_v = v + (k // count + 0.5) / count - NODE_PX * i
                    at_u = u + (k % count + 0.5) / count - NODE_PX * j
                    _interpolate_ray(picture, (i, j), (at_v, at_u), ray)
                    found, x, y, _ = first_meeting(surface, ray[0], ray[1], starts, alike)
                    grey = plain.housing
                    if found:
                        grey = _mixed(plain, strays, blobs, (x, y), side)
                    row = picture.top + v * fine + k // count // part
                    col = picture.left + picture.step * (u * fine + k % count // part)
                    frame[row, col] += grey / (part * part)
