"""An indenter from a mesh file, as a height field seen along its z axis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from cmp_tactile_simulation.errors import IndenterError
from cmp_tactile_simulation.height_field import HeightField

__all__ = ["MAX_FACES", "MeshIndenter"]

Array = NDArray[np.float64]

MAX_FACES = 2_000_000
# As text, a mesh of that many faces is about as large.
MAX_FILE_BYTES = 500_000_000
# Between these, m, is what fits on or under a fingertip; elsewhere the unit is mistaken.
MIN_EXTENT, MAX_EXTENT = 1e-4, 0.2
MAX_GRID_POINTS = 9_000_000
# The default resolution: this many grid points over the longer side, but no finer than needed.
DEFAULT_POINTS, FINEST_DEFAULT = 800, 2e-5
# Heights along z cannot be taken for those of another face, so that steps may be longer than
# the edges' radius.
SHORTEST_FEATURE = 1e-4

# What trimesh raises for files that are not what their name says.
LOAD_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    ImportError,
    RuntimeError,
    MemoryError,
)


@dataclass(frozen=True)
class MeshIndenter:
    """The underside of a mesh, an `Indenter`; the origin is the middle of its bounding box.

    Only what a view from below along its own z axis sees is there: undercuts are filled, and
    walls along z lean a little outwards.  Distances are taken along z and shortened by the slope:
    exact in sign, and at the surface.
    name: of the file.  edge_radius: rounding of edges, m.  reach: m.
    """

    name: str
    field: HeightField
    edge_radius: float
    reach: float

    @classmethod
    def load(
        cls,
        path: Path,
        scale: float = 1.0,
        resolution: float | None = None,
        edge_radius: float | None = None,
    ) -> MeshIndenter:
        """Read a closed mesh (STL, OBJ, PLY, OFF, glTF).

        scale: from the file's unit to m, 0.001 for a file in mm.  resolution: of the heights, m;
        default a point in 800 of the longer side.  edge_radius: m; default two points.
        Raises IndenterError with file, found and expected: for a file that cannot be read, a mesh
        with more than MAX_FACES faces, not watertight or without volume, and for a size or a
        resolution out of range.
        """
        path = Path(path)
        mesh = _read(path)
        low, high = scale * np.asarray(mesh.bounds)
        _check_size(path, high - low, scale)
        longest = float((high - low).max())
        resolution = _checked_resolution(path, high - low, resolution)
        edge_radius = min(2 * resolution, longest / 4) if edge_radius is None else edge_radius
        if not 0 <= edge_radius <= longest / 2:
            msg = (
                f"{path}: edge_radius: found {edge_radius!r} m, expected 0 to {longest / 2:.3g} m, "
                "half of the longest side"
            )
            raise IndenterError(msg)
        triangles = scale * np.asarray(mesh.triangles, dtype=np.float64) - (low + high) / 2
        try:
            heights = HeightField.of_triangles(triangles, resolution, edge_radius)
        except ValueError as error:
            msg = f"{path}: resolution: {error}, expected a finer one"
            raise IndenterError(msg) from None
        return cls(path.name, heights, edge_radius, float(np.linalg.norm(high - low)) / 2)

    @property
    def feature(self) -> float:
        """The edges' radius, m, or what may be taken for it."""
        return max(self.edge_radius, SHORTEST_FEATURE)

    def distance(self, p_indenter: Array) -> tuple[Array, Array]:
        """See Indenter.distance."""
        height, slope = self.field.at(p_indenter[:, :2])
        normal = np.concatenate([slope, -np.ones((len(slope), 1))], axis=1)
        steepness = np.linalg.norm(normal, axis=1)
        return (height - p_indenter[:, 2]) / steepness, normal / steepness[:, None]


def _read(path: Path) -> Any:
    """The mesh of a file, checked but for its size."""
    try:
        size = path.stat().st_size
    except OSError as error:
        msg = f"{path}: mesh file: {error.strerror}, expected a readable file"
        raise IndenterError(msg) from None
    if size > MAX_FILE_BYTES:
        msg = f"{path}: far too fine: found {size} bytes, expected at most {MAX_FILE_BYTES}"
        raise IndenterError(msg)
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except LOAD_ERRORS as error:
        msg = f"{path}: mesh file: cannot be read ({error}), expected STL, OBJ, PLY, OFF or glTF"
        raise IndenterError(msg) from None
    faces = len(getattr(mesh, "faces", ()))
    if not 0 < faces <= MAX_FACES:
        kind = "far too fine" if faces else "no mesh"
        msg = f"{path}: {kind}: found {faces} faces, expected 1 to {MAX_FACES}"
        raise IndenterError(msg)
    if not np.isfinite(mesh.vertices).all():
        msg = f"{path}: found vertices that are not finite numbers, expected finite ones"
        raise IndenterError(msg)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    _check_closed(path, mesh)
    return mesh


def _check_closed(path: Path, mesh: Any) -> None:
    if not mesh.is_watertight:
        edges = np.sort(mesh.edges, axis=1)
        _, counts = np.unique(edges, axis=0, return_counts=True)
        msg = (
            f"{path}: not watertight: found {int((counts != 2).sum())} edges that do not join two "
            "faces, expected a closed surface"
        )
        raise IndenterError(msg)
    with np.errstate(invalid="ignore", divide="ignore"):
        volume = float(mesh.volume)
    if not abs(volume) > 1e-9 * float(np.prod(mesh.extents)):
        msg = f"{path}: found a volume of {volume:.3g}, expected a solid body"
        raise IndenterError(msg)


def _check_size(path: Path, extent: Array, scale: float) -> None:
    longest = float(extent.max())
    if MIN_EXTENT <= longest <= MAX_EXTENT:
        return
    msg = (
        f"{path}: size: found {longest:.3g} m along the longest side with scale {scale:g}, "
        f"expected {MIN_EXTENT:g} to {MAX_EXTENT:g} m; the unit is mistaken: a file in mm needs "
        "scale 0.001"
    )
    raise IndenterError(msg)


def _checked_resolution(path: Path, extent: Array, resolution: float | None) -> float:
    if resolution is None:
        return max(float(extent[:2].max()) / DEFAULT_POINTS, FINEST_DEFAULT)
    points = float(np.prod(extent[:2] / resolution + 1)) if resolution > 0 else np.inf
    if not points <= MAX_GRID_POINTS:
        least = float(np.sqrt(np.prod(extent[:2]) / MAX_GRID_POINTS))
        msg = f"{path}: resolution: found {resolution!r} m, expected at least about {least:.2g} m"
        raise IndenterError(msg)
    return resolution
