"""Triangles over the deformed surface as a view shows them: visibility and first guesses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_simulation.rendering.pixel_rays import BORDER
from cmp_tactile_simulation.rendering.rasterizer import rasterize
from cmp_tactile_simulation.rendering.surface_spline import SplineSurface, surface_points

__all__ = ["SurfaceMesh"]

# Sides of the mesh's cells in the picture, px, and their number along the block.
CELL_PX = 8.0
FEWEST_CELLS, MOST_CELLS = 80, 300
# The mesh reaches so many pixels beyond the block, so that its edge lies between mesh points.
BEYOND_PX = 4.0
# A point that its own pixel's ray misses by more than this, m, is outside what the lens shows.
LENS_TOLERANCE_M = 1e-4


@dataclass(frozen=True)
class SurfaceMesh:
    """Mesh points of a view: material coordinates x (cols,), y (rows,), m.

    shown (rows, cols): points that the lens model can show.  pixel_m: size of a pixel on the
    surface at rest, m.
    """

    view: ViewGeometry
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    shown: NDArray[np.bool_]
    pixel_m: float

    @classmethod
    def from_view(cls, view: ViewGeometry, rest: SplineSurface) -> SurfaceMesh:
        """A mesh for the view of a surface, from the undeformed one."""
        half = rest.half_x, rest.half_y
        coarse = [np.linspace(-side, side, FEWEST_CELLS + 1) for side in half]
        step = np.hypot(coarse[0][1] - coarse[0][0], coarse[1][1] - coarse[1][0])
        pixels = view.project(_points(rest, *coarse))
        diagonal = np.linalg.norm(pixels[1:, 1:] - pixels[:-1, :-1], axis=-1)
        pixel_m = float(step / np.nanmedian(diagonal))
        x, y = (_coordinates(side, pixel_m) for side in half)
        points = _points(rest, x, y)
        with np.errstate(invalid="ignore"):
            origins, directions = view.rays(view.project(points))
            off = np.linalg.norm(np.cross(points - origins, directions), axis=-1)
            return cls(view, x, y, off < LENS_TOLERANCE_M, pixel_m)

    def project(self, surface: SplineSurface) -> NDArray[np.float64]:
        """Mesh points as seen: (rows, cols, 3) of x, y px and 1 / depth; NaN where not shown."""
        points = _points(surface, self.x, self.y)
        pixels = self.view.project(points)
        T = self.view.T_view_gel
        depth = points @ T[2, :3] + T[2, 3]
        seen = np.concatenate([pixels, 1 / depth[..., None]], axis=-1)
        seen[~self.shown | ~(depth > 0)] = np.nan
        return seen

    def guesses(
        self, seen: NDArray[np.float64], rows: tuple[int, int], out: NDArray[np.float64]
    ) -> None:
        """Nearest material point of each pixel of these rows of `out`, as `rasterize` gives it.

        seen: of `project`.  out (height + 2, width + 2, 4): pixel (0, 0) of the view is out[1, 1].
        """
        rasterize(seen, (self.x, self.y), out, BORDER, rows)


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
