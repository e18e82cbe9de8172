"""The triangulation stage: markers in 3-D from two views, or from one and the known surface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, plain
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.geometry.refraction import RayBundle, RayModel
from cmp_tactile_processing.measured import (
    Grid,
    GridShape,
    MarkerFault,
    Markers3D,
    Status,
    no_virtual_markers,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.triangulation import (
    LEAST_STD_PX,
    Triangulated,
    meet_surface,
    triangulate,
)
from cmp_tactile_processing.stereo.virtual_markers import (
    LineNodes,
    Lines3D,
    LineTriangulator,
    SeenLines,
)

MISSING, PREDICTED = int(Status.MISSING), int(Status.PREDICTED)
NOT_SEEN, NOT_SEEN_LEFT = int(MarkerFault.NOT_SEEN), int(MarkerFault.NOT_SEEN_LEFT)
NOT_SEEN_RIGHT = int(MarkerFault.NOT_SEEN_RIGHT)

# On clean frames of the sample rig the median gap is 0.4 um with its own description and 177 um
# with that of the prototype; an error of a whole pixel in every corner makes 41 um.
PLAUSIBLE_RAY_GAP_M = 50e-6
# Fewer markers may all lie where one view is wrong: under glare, or at the rim of a contact.
MIN_MEASURED_SHARE = 0.5


class StereoRig:
    """The two views of a sensor, or the one of a monocular sensor with its known surface.

    One frame at a time: calls from several threads must take turns.
    Raises InputError for a sensor without views.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        if not sensor.views:
            msg = f"{sensor.origin}: views: found none, expected at least one that shows markers"
            raise InputError(msg)
        self._sensor = sensor
        self._options = sensor.triangulation
        self._views = build_views(sensor)
        self._rays = {
            name: RayModel(view.lens, view.T_view_gel, view.layers)
            for name, view in self._views.items()
        }
        known_surface = sensor.pattern.surface if len(self._views) == 1 else None
        self._lines = LineTriangulator(sensor.pattern.shape, self._options, known_surface)
        shape = sensor.pattern.shape
        self._sizes = _array_sizes(shape)
        self._no_lines = no_virtual_markers(shape)
        # Fresh memory would have to be mapped in every frame.
        self._room = {
            (name, kind): RayBundle.empty(math.prod(size))
            for name in self._views
            for kind, size in (
                ("corners", shape.corners),
                ("row_lines", shape.row_lines),
                ("col_lines", shape.col_lines),
            )
        }
        # What is compiled is compiled now, and not in the first frame.
        nothing = {name: Grid.missing(shape, "") for name in self._views}
        markers = self.triangulate(nothing.get("left"), nothing.get("right"))
        implausible_ray_gap(markers.ray_gap, markers.status, sensor.name)

    @property
    def views(self) -> dict[str, ViewGeometry]:
        """Geometry of the views by name."""
        return self._views

    @property
    def baseline(self) -> float:
        """Distance of the two camera centres in m; NaN for a monocular sensor."""
        if len(self._views) < 2:
            return float("nan")
        left, right = self._views["left"], self._views["right"]
        return float(np.linalg.norm(right.centre - left.centre))

    def triangulate(
        self, left: Grid | None, right: Grid | None, *, virtual_markers: bool = True
    ) -> Markers3D:
        """Markers in 3-D from the grids of both views in one frame.

        A marker is measured where both views measured it, predicted where one of them predicted
        it; where it is missing, `fault` says why.  A monocular sensor takes its one grid (the
        other is None) and gives the point of the known surface on the marker's ray, with z NaN.
        Virtual markers are placed along the gridlines as curves: see LineTriangulator; without
        `virtual_markers` all of them are missing, which takes less time.
        Raises InputError for a grid of another shape, with arrays of another one, or a missing
        one.
        """
        grids = {"left": left, "right": right}
        seen = {name: self._checked(name, grids[name]) for name in self._views}
        corners = self._corners(seen)
        codes = [plain(grid.corner_status, np.uint8).reshape(-1) for grid in seen.values()]
        status = np.empty(codes[0].size, np.uint8)
        _settle(codes[0], codes[-1], (corners.position, corners.covariance, corners.fault), status)
        shape = self._sensor.pattern.shape
        nodes = LineNodes(
            corners.position.reshape(*shape.corners, 3),
            status.reshape(shape.corners),
            corners.covariance.reshape(*shape.corners, 3, 3),
        )
        lines = self._lines_of(seen, nodes) if virtual_markers else self._no_lines
        if len(seen) == 1:
            # One view does not measure the height, which so far was that of the known surface.
            nodes.position[..., 2] = np.nan
        return Markers3D(
            shape=shape,
            position=nodes.position,
            status=nodes.status,
            fault=corners.fault.reshape(shape.corners),
            covariance=nodes.covariance,
            ray_gap=corners.gap.reshape(shape.corners),
            pixels={name: grid.corners for name, grid in seen.items()},
            **lines,
        )

    def _lines_of(self, seen: dict[str, Grid], nodes: LineNodes) -> dict[str, NDArray[Any]]:
        """The fields of Markers3D for virtual markers."""
        found: dict[str, NDArray[Any]] = {}
        for name, kind in (("row", "row_lines"), ("col", "col_lines")):
            lines = self._virtual_markers(kind, seen, nodes)
            if len(seen) == 1:
                lines.position[..., 2] = np.nan  # as that of the corners
            found |= {
                f"{name}_position": lines.position,
                f"{name}_status": lines.status,
                f"{name}_std": lines.std,
            }
        return found

    def _virtual_markers(self, kind: str, grids: dict[str, Grid], nodes: LineNodes) -> Lines3D:
        """Virtual markers along the rows or along the columns; kind: row_lines or col_lines."""
        views = [
            (grid, self._bundle(name, kind, getattr(grid, kind))) for name, grid in grids.items()
        ]
        if kind == "row_lines":
            return self._lines.rows(tuple(SeenLines.rows(*view) for view in views), nodes)
        return self._lines.cols(tuple(SeenLines.cols(*view) for view in views), nodes)

    def _checked(self, name: str, grid: Grid | None) -> Grid:
        shape = self._sensor.pattern.shape
        if grid is None:
            msg = f"{name} grid: found none, expected one of {shape.rows} x {shape.cols} corners"
            raise InputError(msg)
        if grid.shape != shape:
            msg = f"{name} grid: found {grid.shape}, expected {shape}"
            raise InputError(msg)
        for field, size in self._sizes.items():
            # Compiled loops check no bounds.
            array = getattr(grid, field)
            if array is not None and array.shape != size:
                msg = f"{name} grid: {field}: found {array.shape}, expected {size}"
                raise InputError(msg)
        return grid

    def _corners(self, grids: dict[str, Grid]) -> Triangulated:
        """Points of all corners; those of a monocular sensor with the height of its surface."""
        rays = [self._bundle(name, "corners", grid.corners) for name, grid in grids.items()]
        std = [self._std(grid) for grid in grids.values()]
        if len(rays) == 1:
            return meet_surface(rays[0], std[0], self._sensor.pattern.surface)
        return triangulate(
            (rays[0], rays[1]),
            (std[0], std[1]),
            weighted=self._options.method == "weighted",
            max_gap=self._options.max_ray_gap,
        )

    def _bundle(self, view: str, kind: str, pixels: NDArray[np.float64]) -> RayBundle:
        """Rays of a view's pixels, in the room for their kind."""
        return self._rays[view].bundle(pixels, self._room[view, kind])

    def _std(self, grid: Grid) -> NDArray[np.float64]:
        """Standard deviation of each corner (N,), px: its own, else that of the parameters."""
        unknown = self._options.corner_noise
        if grid.corner_std is None:
            return np.full(grid.corner_status.size, unknown)
        std = np.empty(grid.corner_status.size)
        _fill_std(plain(grid.corner_std, np.float64).reshape(-1), unknown, std)
        return std


def _array_sizes(shape: GridShape) -> dict[str, tuple[int, ...]]:
    """Shape of each array of a grid, by the name of its field."""
    sizes: dict[str, tuple[int, ...]] = {}
    for kind in ("corners", "row_lines", "col_lines"):
        size, name = getattr(shape, kind), kind[:-1]
        sizes |= {kind: (*size, 2), f"{name}_status": size, f"{name}_std": size}
    return sizes


@kernel
def _settle(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    corners: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]],
    status: NDArray[np.uint8],
) -> None:
    """Fill the status (N,) from that in both views, of a monocular sensor twice the same.

    corners: position, covariance, fault; in place, where not every view has a marker.
    """
    position, covariance, fault = corners
    for n in range(len(status)):
        if left[n] == MISSING or right[n] == MISSING:
            fault[n] = NOT_SEEN_LEFT if right[n] != MISSING else NOT_SEEN_RIGHT
            fault[n] = NOT_SEEN if left[n] == right[n] else fault[n]
        status[n] = max(left[n], right[n])
        if fault[n]:
            position[n], covariance[n], status[n] = np.nan, np.nan, MISSING


@kernel
def _fill_std(given: NDArray[np.float64], unknown: float, std: NDArray[np.float64]) -> None:
    """Fill std (N,) from that of the corners, and where it is not finite, from the unknown's."""
    for n in range(len(std)):
        std[n] = max(given[n] if math.isfinite(given[n]) else unknown, LEAST_STD_PX)


def implausible_ray_gap(
    ray_gap: NDArray[np.float64], status: NDArray[np.uint8], sensor_name: str
) -> str:
    """Why the frame cannot come from that sensor; empty where it may.

    ray_gap, status (rows, cols): of a surface; gaps in m, NaN for a sensor with one view.  Markers
    that are missing for their gap alone count.
    """
    known, plausible = _count_gaps(ray_gap, status, PLAUSIBLE_RAY_GAP_M)
    # With more than half of the gaps, the median is plausible: it is hardly ever to be found.
    if known < MIN_MEASURED_SHARE * ray_gap.size or 2 * plausible > known or not known:
        return ""
    median = float(np.median(ray_gap[(status != Status.PREDICTED) & np.isfinite(ray_gap)]))
    if median <= PLAUSIBLE_RAY_GAP_M:
        return ""
    return (
        f"the left and right rays of a marker are {median * 1e6:.0f} um apart, expected at most "
        f"{PLAUSIBLE_RAY_GAP_M * 1e6:.0f} um: is {sensor_name} the description of this sensor?"
    )


@kernel
def _count_gaps(
    ray_gap: NDArray[np.float64], status: NDArray[np.uint8], most: float
) -> tuple[int, int]:
    """How many gaps are known of markers that are not predicted, and up to `most` of them."""
    known = plausible = 0
    for gap, code in zip(ray_gap.flat, status.flat):  # noqa: B905 - numba knows no strict
        if code != PREDICTED and math.isfinite(gap):
            known += 1
            plausible += gap <= most
    return known, plausible
