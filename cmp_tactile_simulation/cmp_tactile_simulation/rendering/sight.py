"""What the views of a sensor see of its deformed surface.

The rays of nodes, a lattice in each view, meet the surface exactly.  Between nodes the material
point is the cubic through the 4 x 4 nodes around, but where the surface folds or ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part
from cmp_tactile_processing.elastic.mesh import BlockGeometry
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering.surface import (
    DeformedSurface,
    SplineSurface,
    first_meetings,
    meet,
    surface_points,
)

# Distance of the nodes, px.
NODE_PX = 4
# Sides of the mesh's cells in the picture, px, and their number along the block.
CELL_PX = 8.0
FEWEST_CELLS, MOST_CELLS = 80, 300
# The mesh reaches so many pixels beyond the block, so that all cells of it have their 4 x 4 nodes.
BEYOND_PX = 6.0 * NODE_PX
# A point that its own pixel's ray misses by more than this, m, is outside what the lens shows.
LENS_TOLERANCE_M = 1e-4

# A marker is hidden where its ray first meets the surface further than this from it, m.
SAME_POINT_M = 1e-7
# It is seen where the cubic is nearer to it than this share of a pixel: that is no other sheet.
SURE_PX = 0.1
# Guesses this near to each other, in pixels, lead to the same meeting.
ALIKE_PX = 2.0


class SensorViews:
    """The views of one sensor.  Raises InputError for a sensor without a block."""

    def __init__(self, sensor: SensorDescription) -> None:
        self.size = BlockGeometry.from_sensor(sensor).size[:2]
        rest = DeformedSurface.rest(sensor.pattern).spline(self.size)
        self._views = [ViewNodes.from_view(view, rest) for view in build_views(sensor).values()]
        self._latest: tuple[DeformedSurface, list[Sight]] | None = None

    def see(self, surface: DeformedSurface) -> list[Sight]:
        """What each view sees; kept for the surface that was asked for last."""
        if self._latest is None or self._latest[0] is not surface:
            spline = surface.spline(self.size)
            self._latest = surface, [view.see(spline) for view in self._views]
        return self._latest[1]


@dataclass(frozen=True)
class ViewNodes:
    """The nodes of a view, and the points of a mesh over the surface from which they begin.

    Cell (i, j) of NODE_PX x NODE_PX pixels has the nodes [i + 1 : i + 3, j + 1 : j + 3] at its
    corners.  origins, directions: of the nodes' rays inside the gel, see ViewGeometry.rays; (rows +
    3, cols + 3, 3) for rows x cols cells, but origins (1, 1, 3) where all rays have one.
    x, y: material coordinates of the mesh's columns and rows, m.  shown: of its points those that
    the lens model can show.  front: sign of the area in the picture of what faces the view.
    pixel_m: size of a pixel on the surface at rest, m.
    """

    view: ViewGeometry
    origins: NDArray[np.float64]
    directions: NDArray[np.float64]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    shown: NDArray[np.bool_]
    front: float
    pixel_m: float

    @classmethod
    def from_view(cls, view: ViewGeometry, rest: SplineSurface) -> ViewNodes:
        """Those of a view of a surface, from the undeformed one."""
        half = rest.half_x, rest.half_y
        coarse = [np.linspace(-side, side, FEWEST_CELLS + 1) for side in half]
        step = np.hypot(coarse[0][1] - coarse[0][0], coarse[1][1] - coarse[1][0])
        pixels = view.project(_points(rest, *coarse))
        along, across = (pixels[1:, 1:] - pixels[:-1, :-1], pixels[1:, :-1] - pixels[:-1, 1:])
        pixel_m = float(step / np.nanmedian(np.linalg.norm(along, axis=-1)))
        turned = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
        x, y = (_coordinates(side, pixel_m) for side in half)
        points = _points(rest, x, y)
        with np.errstate(invalid="ignore"):
            origins, directions = view.rays(view.project(points))
            off = np.linalg.norm(np.cross(points - origins, directions), axis=-1)
        front = float(np.sign(np.nanmedian(turned)))
        return cls(view, *_node_rays(view), x, y, off < LENS_TOLERANCE_M, front, pixel_m)

    def see(self, surface: SplineSurface) -> Sight:
        """What the view sees of a surface."""
        points = _points(surface, self.x, self.y)
        T = self.view.T_view_gel
        depth = points @ T[2, :3] + T[2, 3]
        mesh = np.concatenate([self.view.project(points), 1 / depth[..., None]], axis=-1)
        mesh[~self.shown | ~(depth > 0)] = np.nan
        nodes = np.empty((*self.directions.shape[:2], 3))
        folded = np.zeros((nodes.shape[0] - 3, nodes.shape[1] - 3), dtype=np.bool_)
        on_nodes = mesh * (1 / NODE_PX, 1 / NODE_PX, 1) + (0.5 / NODE_PX + 1, 0.5 / NODE_PX + 1, 0)
        rasterize(on_nodes, self.x, self.y, nodes)
        _mark_folds(on_nodes, self.front, folded)
        _meet_nodes(surface, (self.origins, self.directions), self.pixel_m, nodes)
        return Sight(self, surface, mesh, nodes, folded)


def _node_rays(view: ViewGeometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    sides = view.placement.height, view.placement.width
    v, u = (NODE_PX * (np.arange(-(-side // NODE_PX) + 3.0) - 1) - 0.5 for side in sides)
    origins, directions = view.rays(np.stack(np.meshgrid(u, v), axis=-1))
    if not view.layers:
        origins = view.centre.reshape(1, 1, 3)
    return np.ascontiguousarray(origins), np.ascontiguousarray(directions)


@dataclass(frozen=True)
class Sight:
    """What a view sees of a surface.

    mesh (rows, cols, 3): pixel and 1 / depth of the mesh's points.  nodes: material x, y, m, and
    1 / depth of the nodes of `at`; NaN where their rays miss.  folded: cells over which the surface
    may turn its back to the view.
    """

    at: ViewNodes
    surface: SplineSurface
    mesh: NDArray[np.float64]
    nodes: NDArray[np.float64]
    folded: NDArray[np.bool_]

    def guesses(self, rows: tuple[int, int]) -> NDArray[np.float64]:
        """About what the pixels of these rows (first, last + 1) and those around them show.

        (last - first + 3, width + 2, 3), as `rasterize` gives it.
        """
        guesses = np.empty((rows[1] - rows[0] + 2, self.at.view.placement.width + 2, 3))
        rasterize(self.mesh + (1, 1 - rows[0], 0), self.at.x, self.at.y, guesses)
        return guesses

    def pixels(self, material: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels (..., 2) of the view of material points (..., 2) m; NaN where they are not seen.

        A point is seen where its ray meets the surface nowhere nearer.  Where the nodes do not say,
        that is looked for from what the pixels around it show.
        """
        xy = np.ascontiguousarray(material.reshape(-1, 2))
        q, place = self.at.view.project(surface_points(self.surface, xy)), self.at.view.placement
        with np.errstate(invalid="ignore"):
            inside = (q > -0.5).all(axis=1)
            inside &= (q < (place.width - 0.5, place.height - 0.5)).all(axis=1)
            off = np.linalg.norm(_shown_at(self.nodes, self.folded, q) - xy, axis=1)
            seen = inside & (off < SURE_PX * self.at.pixel_m)
        unsure = np.flatnonzero(inside & ~seen)
        if len(unsure):
            seen[unsure] = self._is_first(xy[unsure], q[unsure])
        q[~seen] = np.nan
        return q.reshape(material.shape)

    def _is_first(self, xy: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the rays of pixels q meet the surface first in the material points xy, (n, 2)."""
        guesses = self.guesses((0, self.at.view.placement.height))
        col, row = np.rint(q).astype(np.intp).T + 1
        near = np.arange(-1, 2)
        around = guesses[row[:, None, None] + near[:, None], col[:, None, None] + near, :2]
        # The point itself first: most are seen.
        starts = np.concatenate([xy[:, None], around.reshape(len(q), 9, 2)], axis=1)
        alike = ALIKE_PX * self.at.pixel_m
        first = first_meetings(self.surface, *self.at.view.rays(q), starts, alike)
        return np.asarray(np.linalg.norm(first - xy, axis=1) < SAME_POINT_M)


def _coordinates(half: float, pixel_m: float) -> NDArray[np.float64]:
    cells = int(np.clip(2 * half / (CELL_PX * pixel_m), FEWEST_CELLS, MOST_CELLS))
    beyond = BEYOND_PX * pixel_m
    inner = np.linspace(-half, half, cells + 1)
    return np.concatenate([[-half - beyond], inner, [half + beyond]])


def _points(
    surface: SplineSurface, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    grid_y, grid_x = np.meshgrid(y, x, indexing="ij")
    flat = np.stack([grid_x.ravel(), grid_y.ravel()], axis=-1)
    return np.asarray(surface_points(surface, flat)).reshape(*grid_x.shape, 3)


# Between the nodes.


@kernel_part(forceinline=True)
def cubic_weights(t: float) -> Any:
    """Weights of values at -1, 0, 1 and 2 in the cubic through them, at t."""
    a, b, c, d = t + 1, t, t - 1, t - 2
    return -b * c * d / 6, a * c * d / 2, -a * b * d / 2, a * b * c / 6


@kernel_part(forceinline=True)
def between(
    nodes: NDArray[np.float64], cell: tuple[int, int], down: Any, right: Any, c: int
) -> float:
    """Component c of the nodes' cubic in a cell; down, right: weights of rows and columns."""
    i, j = cell
    total = 0.0
    for k in range(4):
        row = nodes[i + k]
        along = right[0] * row[j, c] + right[1] * row[j + 1, c]
        total += down[k] * (along + right[2] * row[j + 2, c] + right[3] * row[j + 3, c])
    return total


@kernel
def _shown_at(
    nodes: NDArray[np.float64], folded: NDArray[np.bool_], q: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Material points (n, 2) m that pixels (n, 2) show; NaN where the nodes do not say."""
    xy = np.full((len(q), 2), np.nan)
    for k in range(len(q)):
        u, v = (q[k, 0] + 0.5) / NODE_PX, (q[k, 1] + 0.5) / NODE_PX
        if not (0 <= u < folded.shape[1] and 0 <= v < folded.shape[0]):
            continue
        i, j = int(v), int(u)
        if not folded[i, j]:
            down, right = cubic_weights(v - i), cubic_weights(u - j)
            for c in range(2):
                xy[k, c] = between(nodes, (i, j), down, right, c)
    return xy


@kernel
def _meet_nodes(
    surface: SplineSurface,
    rays: tuple[NDArray[np.float64], NDArray[np.float64]],
    pixel_m: float,
    nodes: NDArray[np.float64],
) -> None:
    """Make the nodes' material points exact, in place; NaN where a ray does not meet one."""
    origins, directions = rays
    for v in range(nodes.shape[0]):
        row = nodes[v]
        for u in range(len(row)):
            x, y = row[u, 0], row[u, 1]
            if np.isnan(x):
                continue
            if u > 2:
                # What goes on from the nodes before is nearer still, unless it is another sheet.
                next_x = 3 * (row[u - 1, 0] - row[u - 2, 0]) + row[u - 3, 0]
                next_y = 3 * (row[u - 1, 1] - row[u - 2, 1]) + row[u - 3, 1]
                if abs(next_x - x) + abs(next_y - y) < pixel_m:
                    x, y = next_x, next_y
            origin = origins[min(v, origins.shape[0] - 1), min(u, origins.shape[1] - 1)]
            good, x, y, _ = meet(surface, origin, directions[v, u], x, y)
            row[u, 0], row[u, 1] = (x, y) if good else (np.nan, np.nan)


# Draws a mesh of material points into the picture, the nearest in front.


@kernel
def rasterize(
    mesh: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Fill `out` (h, w, 3): material x, y (m) and 1 / depth.

    mesh (rows, cols, 3): place in `out`, right and down, and 1 / depth of the mesh's points.
    x (cols,), y (rows,): their material coordinates, m.  NaN where no triangle covers a place; of
    several triangles the nearest, of equally near ones the first.
    """
    out[:] = np.nan
    for row in range(mesh.shape[0] - 1):
        for col in range(mesh.shape[1] - 1):
            corner = (mesh[row, col], x[col], y[row])
            across = (mesh[row, col + 1], x[col + 1], y[row])
            along = (mesh[row + 1, col], x[col], y[row + 1])
            opposite = (mesh[row + 1, col + 1], x[col + 1], y[row + 1])
            _draw((corner, across, opposite), out)
            _draw((corner, opposite, along), out)


@kernel
def rasterize_triangles(corners: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Fill `out` (h, w, 3): number of the nearest triangle, 0, and 1 / depth; or NaN.

    corners (n, 3, 3): place in `out`, right and down, and 1 / depth.
    """
    out[:] = np.nan
    for n in range(len(corners)):
        a, b, c = corners[n]
        _draw(((a, float(n), 0.0), (b, float(n), 0.0), (c, float(n), 0.0)), out)


@kernel_part(forceinline=True)
def _area(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> Any:
    """Twice the area of a triangle, negative where it is turned round."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@kernel
def _mark_folds(mesh: NDArray[np.float64], front: float, folded: NDArray[np.bool_]) -> None:
    """Mark the cells at triangles that do not face the view; mesh: as for the nodes."""
    for row in range(mesh.shape[0] - 1):
        for col in range(mesh.shape[1] - 1):
            a, b = mesh[row, col], mesh[row, col + 1]
            c, d = mesh[row + 1, col + 1], mesh[row + 1, col]
            if front * _area(a, b, c) <= 0 or front * _area(a, c, d) <= 0:
                # A cell more on all sides.
                left = int(max(min(a[0], b[0], c[0], d[0]) - 2, 0))
                top = int(max(min(a[1], b[1], c[1], d[1]) - 2, 0))
                right = int(max(max(a[0], b[0], c[0], d[0]) + 1, 0))
                bottom = int(max(max(a[1], b[1], c[1], d[1]) + 1, 0))
                folded[top:bottom, left:right] = True


@kernel_part(forceinline=True)
def _draw(triangle: Any, out: NDArray[np.float64]) -> None:
    a, b, c = triangle
    qa, qb, qc = a[0], b[0], c[0]
    area = _area(qa, qb, qc)
    if not abs(area) > 0:
        return
    share = 1 / area
    top = int(max(np.ceil(min(qa[1], qb[1], qc[1])), 0))
    bottom = int(min(np.floor(max(qa[1], qb[1], qc[1])), out.shape[0] - 1))
    left = int(max(np.ceil(min(qa[0], qb[0], qc[0])), 0))
    right = int(min(np.floor(max(qa[0], qb[0], qc[0])), out.shape[1] - 1))
    for v in range(top, bottom + 1):
        for u in range(left, right + 1):
            wa = ((qb[0] - u) * (qc[1] - v) - (qb[1] - v) * (qc[0] - u)) * share
            wb = ((qc[0] - u) * (qa[1] - v) - (qc[1] - v) * (qa[0] - u)) * share
            wc = 1 - wa - wb
            if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                continue
            wa, wb, wc = wa * qa[2], wb * qb[2], wc * qc[2]
            near = wa + wb + wc
            if not out[v, u, 2] >= near:
                # Straight in space, not in the picture.
                far = 1 / near
                out[v, u, 0] = (wa * a[1] + wb * b[1] + wc * c[1]) * far
                out[v, u, 1] = (wa * a[2] + wb * b[2] + wc * c[2]) * far
                out[v, u, 2] = near
