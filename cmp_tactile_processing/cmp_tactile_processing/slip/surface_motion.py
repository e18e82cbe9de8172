"""Where the deformed contact surface lies and which way it faces, at the force nodes.

What slides, slides along the contact surface, which lies above the markers by the shading layer.
A layer of 0.3 mm under a sliding ball of 8 mm radius turns the mean normal by 0.03 rad against
that of the marker surface, which would make an error of 0.03 of the friction coefficient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.measured import Status, Surface, SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription

# Rounds in which unknown markers take the mean of their known neighbours: the largest gap, in
# markers from its rim to its middle, that is bridged.
FILL_ROUNDS = 4


@dataclass(frozen=True)
class DeformedNodes:
    """The force nodes of a frame, gel frame.

    rest (M, 2) m: undeformed.  place (M, 3) m: on the deformed contact surface.  normal (M, 3):
    its unit normal, out of the gel; both NaN amid more missing markers than can be bridged.
    known (M,): share of the markers around a node that are measured, 0 to 1.
    spacing: mean distance of neighbours, m.
    """

    rest: NDArray[np.float64]
    place: NDArray[np.float64]
    normal: NDArray[np.float64]
    known: NDArray[np.float64]
    spacing: float


class ContactSurface:
    """The contact surface of a sensor, from its markers and the traction on it."""

    def __init__(self, sensor: SensorDescription) -> None:
        problem, elastomer = ElasticProblem.from_sensor(sensor), sensor.elastomer
        self.nodes, self._markers = problem.nodes, problem.markers
        self._rest, self._rest_nodes = sensor.pattern.corners(), problem.nodes.points
        layer, poisson = elastomer.shading_layer, elastomer.poisson
        compliance = 2 * (1 + poisson) / layer.young if layer.thickness > 0 else 0.0
        shear = layer.thickness * compliance / (self.nodes.spacing[0] * self.nodes.spacing[1])
        # What is stretched along the surface becomes thinner; pressure alone hardly matters.
        self._layer = float(layer.thickness), float(poisson / (1 - poisson)), float(shear)
        self._corner, self._weight = _interpolation(self._markers, self.nodes)

    def at_nodes(self, surface: Surface, force: NDArray[np.float64]) -> DeformedNodes:
        """The nodes of a frame.  force: (M, 3) N, 0 outside of contact."""
        moved = np.require(surface.displacement, np.float64, ["C", "W"])
        status = np.require(surface.status, np.uint8, ["C", "W"])
        at_markers = _at_markers(moved, status, self._rest, self._markers.spacing)
        grid, layer = (self.nodes.rows, self.nodes.cols), self._layer
        place, normal, share = _at_nodes(at_markers, self._corner, self._weight, grid, force, layer)
        spacing = float(np.mean(self.nodes.spacing))
        return DeformedNodes(self._rest_nodes, place, normal, share, spacing)


@kernel_part
def _fill(values: NDArray[np.float64], known: NDArray[np.bool_]) -> None:
    """Replace unknown values (rows, cols, 3), 0 there, by the mean of their neighbours.

    NaN where that reaches none.
    """
    if known.all():
        return
    filled, new = known.copy(), known.copy()
    for _ in range(FILL_ROUNDS):
        before = values.copy()
        for i in range(len(filled)):
            for j in range(filled.shape[1]):
                if not filled[i, j]:
                    new[i, j] = _mean_around(before, filled, i, j, values[i, j])
        filled = new.copy()
    for i in range(len(filled)):
        for j in range(filled.shape[1]):
            for c in range(3):
                values[i, j, c] = values[i, j, c] if filled[i, j] else np.nan


@kernel_part
def _mean_around(
    values: NDArray[np.float64],
    filled: NDArray[np.bool_],
    i: int,
    j: int,
    mean: NDArray[np.float64],
) -> bool:
    """Write the mean of a point's neighbours that are filled; whether there are any."""
    rows, cols = filled.shape
    total, count = np.zeros(3), 0
    for k in range(max(i - 1, 0), min(i + 2, rows)):
        for m in range(max(j - 1, 0), min(j + 2, cols)):
            if filled[k, m]:
                for c in range(3):
                    total[c] += values[k, m, c]
                count += 1
    if count > 0:
        for c in range(3):
            mean[c] = total[c] / count
    return count > 0


@kernel
def _at_markers(
    displacement: NDArray[np.float64],
    status: NDArray[np.uint8],
    rest: NDArray[np.float64],
    spacing: tuple[float, float],
) -> NDArray[np.float64]:
    """Place, how much the surface is spread, and whether it is known, (markers, 5)."""
    rows, cols = status.shape
    moved, known = np.zeros((rows, cols, 3)), status != Status.MISSING.value
    for i in range(rows):
        for j in range(cols):
            for c in range(3):
                known[i, j] = known[i, j] and np.isfinite(displacement[i, j, c])
            for c in range(3):
                moved[i, j, c] = displacement[i, j, c] if known[i, j] else 0.0
    if not known.all():
        _fill(moved, known)
    found: NDArray[np.float64] = np.empty((rows * cols, 5))
    for i in range(rows):
        for j in range(cols):
            left, right = max(j - 1, 0), min(j + 1, cols - 1)
            low, high = max(i - 1, 0), min(i + 1, rows - 1)
            at = found[i * cols + j]
            for c in range(3):
                at[c] = rest[i, j, c] + moved[i, j, c]
            at[3] = (moved[i, right, 0] - moved[i, left, 0]) / ((right - left) * spacing[0])
            at[3] += (moved[high, j, 1] - moved[low, j, 1]) / ((high - low) * spacing[1])
            at[4] = 1.0 if known[i, j] else 0.0
    return found


@kernel
def _at_nodes(  # noqa: PLR0913, PLR0917 - flat arrays, as the compiler wants them
    at_markers: NDArray[np.float64],
    corner: NDArray[np.intp],
    weight: NDArray[np.float64],
    shape: tuple[int, int],
    force: NDArray[np.float64],
    layer: tuple[float, float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Place and normal (nodes, 3) of the contact surface, and the share (nodes,) that is known.

    layer: thickness, its loss by how much the surface is spread, and the way along the surface
    that a force moves its top, m/N.
    """
    count = len(corner)
    place: NDArray[np.float64] = np.empty((count, 3))
    spread, share = np.empty(count), np.empty(count)
    for m in range(count):
        x, y, z, s, t = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(corner.shape[1]):
            at, w = at_markers[corner[m, k]], weight[m, k]
            x, y, z = x + w * at[0], y + w * at[1], z + w * at[2]
            s, t = s + w * at[3], t + w * at[4]
        place[m, 0], place[m, 1], place[m, 2] = x, y, z
        spread[m], share[m] = s, t
    thickness, thinning, shear = layer
    normal = _normals(place, shape)
    for m in range(count):
        into = 0.0
        for c in range(3):
            into += force[m, c] * normal[m, c]
        height = thickness * (1 - thinning * spread[m])
        for c in range(3):
            along = force[m, c] - into * normal[m, c]
            place[m, c] += height * normal[m, c] + shear * along
    return place, _normals(place, shape), share


@kernel_part
def _normals(place: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Unit normals (nodes, 3) of a grid of points (nodes, 3), out of the gel."""
    rows, cols = shape
    normal: NDArray[np.float64] = np.empty(place.shape)
    for i in range(rows):
        for j in range(cols):
            left, right = max(j - 1, 0), min(j + 1, cols - 1)
            low, high = max(i - 1, 0), min(i + 1, rows - 1)
            p, q = place[i * cols + right], place[i * cols + left]
            a0, a1, a2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            p, q = place[high * cols + j], place[low * cols + j]
            b0, b1, b2 = p[0] - q[0], p[1] - q[1], p[2] - q[2]
            x, y, z = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            size = np.sqrt(x * x + y * y + z * z)
            at = normal[i * cols + j]
            at[0], at[1], at[2] = x / size, y / size, z / size
    return normal


def _interpolation(
    markers: SurfaceGrid, nodes: SurfaceGrid
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Numbers (M, 4) and weights (M, 4) of the markers around each node; clamped outside."""
    points = nodes.points
    at = [(points[:, axis] + markers.extent[axis] / 2) / markers.spacing[axis] for axis in (0, 1)]
    counts = markers.cols, markers.rows
    first = [np.clip(a.astype(np.intp), 0, n - 2) for a, n in zip(at, counts, strict=True)]
    u, v = (np.clip(a - f, 0.0, 1.0) for a, f in zip(at, first, strict=True))
    corner = first[1] * markers.cols + first[0]
    numbers = np.stack([corner, corner + 1, corner + markers.cols, corner + markers.cols + 1], 1)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
    return numbers, weights
