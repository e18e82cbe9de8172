"""What is drawn in 3-D, as arrays in mm: the gel's surface by colour, arrows, lines, ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.drawing import (
    DEPTH_PALETTE,
    SLIP_COLOURS,
    closed,
    mesh_vertices,
    turning_arrow,
)
from cmp_tactile_processing.measured import Contact, ForceField, SlipState, Surface

MM = 1e3
# The page's meshes have one colour each: so many steps are told apart, and read on the legend.
BANDS = 14
# In which the peak that sets the end of the colours fades to half.
HALF_LIFE_S = 5.0
# Drawn lengths at gain 1: of a node's force, of a contact's, of its moment.
NODE_MM_PER_N, CONTACT_MM_PER_N, MOMENT_MM_PER_NM = 25.0, 1.0, 500.0
# Shorter arrows would only be dots.
SHORTEST_MM = 0.1
# The ellipsoid holds the true force in 95 % of the cases: chi-square with three degrees of freedom.
ELLIPSOID_SIGMA = 2.796


def band_colours() -> NDArray[np.uint8]:
    """Colours (BANDS, 3) RGB, from the palette that RViz shows too."""
    middle = (np.arange(BANDS) + 0.5) / BANDS * len(DEPTH_PALETTE)
    return np.rint(255 * DEPTH_PALETTE[middle.astype(int), :3]).astype(np.uint8)


@dataclass(frozen=True)
class Mesh:
    """vertices (V, 3) float32 mm; faces (F, 3) uint32, seen from +z counter-clockwise."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]


# Of a band without triangles: viewers want at least one, so this one has no area.
EMPTY = Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32))


def refined_surface(surface: Surface) -> NDArray[np.float64]:
    """Points (2 rows - 1, 2 cols - 1, 3) m: markers, the middle of each line between two, cells.

    A virtual marker that is not known is replaced by the middle of its corners.  The middle of a
    cell is that of the Coons patch of its four lines.
    """
    corners = surface.position
    fine = refined(corners)
    fine[::2, 1::2] = _known_or(_middle(surface.row_position), fine[::2, 1::2])
    fine[1::2, ::2] = _known_or(_middle(surface.col_position), fine[1::2, ::2])
    lines = fine[:-1:2, 1::2] + fine[2::2, 1::2] + fine[1::2, :-1:2] + fine[1::2, 2::2]
    ends = corners[:-1, :-1] + corners[:-1, 1:] + corners[1:, :-1] + corners[1:, 1:]
    fine[1::2, 1::2] = lines / 2 - ends / 4
    return fine


def refined(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values (rows, cols, ...) with the means between neighbours, (2 rows - 1, 2 cols - 1, ...)."""
    rows, cols = values.shape[:2]
    fine = np.empty((2 * rows - 1, 2 * cols - 1, *values.shape[2:]))
    fine[::2, ::2] = values
    fine[::2, 1::2] = (values[:, :-1] + values[:, 1:]) / 2
    fine[1::2] = (fine[:-1:2] + fine[2::2]) / 2
    return fine


def _middle(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """The middle of lines (a, b, n, 3) of n markers, (a, b, 3); NaN where there are none."""
    count = line.shape[2]
    if not count:
        return np.full((*line.shape[:2], 3), np.nan)
    return np.asarray((line[:, :, (count - 1) // 2] + line[:, :, count // 2]) / 2)


def _known_or(values: NDArray[np.float64], otherwise: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, otherwise)


def whole_mesh(points: NDArray[np.float64]) -> Mesh:
    """All triangles of a grid of points (rows, cols, 3) m that are known."""
    known = np.asarray(np.isfinite(points).all(axis=-1))
    faces = mesh_vertices(known).reshape(-1, 3)
    return _compact(points.reshape(-1, 3), faces)


def triangle_mesh(triangles: NDArray[np.float64]) -> Mesh:
    """Triangles (n, 3, 3) m; none shares a corner with another, which shows its edges."""
    faces = np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)
    return Mesh((MM * triangles.reshape(-1, 3)).astype(np.float32), faces)


def colour_bands(
    points: NDArray[np.float64], values: NDArray[np.float64], top: float
) -> list[Mesh]:
    """BANDS meshes: the triangles whose mean value is in each step from 0 to `top`.

    points (rows, cols, 3) m; values (rows, cols), of which NaN counts as 0.
    """
    known = np.asarray(np.isfinite(points).all(axis=-1))
    faces = mesh_vertices(known).reshape(-1, 3)
    level = np.nan_to_num(values.ravel())[faces].mean(axis=1) * (BANDS / top)
    band = np.clip(level, 0, BANDS - 1).astype(np.intp)
    flat = points.reshape(-1, 3)
    return [_compact(flat, faces[band == number]) for number in range(BANDS)]


def _compact(points: NDArray[np.float64], faces: NDArray[np.intp]) -> Mesh:
    """Only the points that faces (F, 3) use."""
    if not len(faces):
        return EMPTY
    used = np.zeros(len(points), bool)
    used[faces.ravel()] = True
    number = np.cumsum(used, dtype=np.uint32) - 1
    return Mesh((points[used] * MM).astype(np.float32), number[faces].astype(np.uint32))


def pressure_at(surface: Surface, force: ForceField) -> NDArray[np.float64]:
    """Normal pressure (rows, cols) Pa at the markers at rest, between the nodes' linearly."""
    nodes = force.position.reshape(force.rows, force.cols, 3)
    x, y = nodes[0, :, 0], nodes[:, 0, 1]
    step = (x[-1] - x[0]) / (len(x) - 1), (y[-1] - y[0]) / (len(y) - 1)
    pressure = -force.force[:, 2].reshape(force.rows, force.cols) / abs(step[0] * step[1])
    column = np.nan_to_num((surface.reference[..., 0] - x[0]) / step[0])
    row = np.nan_to_num((surface.reference[..., 1] - y[0]) / step[1])
    inside = (column >= 0) & (column <= len(x) - 1) & (row >= 0) & (row <= len(y) - 1)
    j = np.clip(column.astype(np.intp), 0, len(x) - 2)
    i = np.clip(row.astype(np.intp), 0, len(y) - 2)
    across, down = column - j, row - i
    left = (1 - down) * pressure[i, j] + down * pressure[i + 1, j]
    right = (1 - down) * pressure[i, j + 1] + down * pressure[i + 1, j + 1]
    return np.where(inside, (1 - across) * left + across * right, 0.0)


class ColourRange:
    """The value at which the colours end: the next of 1, 2, 5, 10 ... above the peak of late.

    The peak of the values fades slowly: frames that follow one another have the same colours, and
    a knock is forgotten.
    """

    def __init__(self, kind: str, least: float) -> None:
        """kind: of the values.  least: below which the colours never end."""
        self._kind = kind
        self._begin(least)

    def _begin(self, least: float) -> None:
        self.top = self._least = self._peak = least
        self._stamp_ns = 0

    def take(self, values: NDArray[np.float64], stamp_ns: int) -> None:
        """Take the values of a frame into account."""
        # A recording may be gone back in.
        passed_s = max(stamp_ns - self._stamp_ns, 0) * 1e-9
        self._stamp_ns = stamp_ns
        known = values[np.isfinite(values)]
        faded = self._peak * 0.5 ** (passed_s / HALF_LIFE_S)
        self._peak = max(self._least, faded, float(known.max()) if known.size else 0.0)
        power = 10.0 ** np.floor(np.log10(self._peak))
        steps = (step * power for step in (1, 2, 5, 10))
        self.top = float(next(top for top in steps if top >= self._peak))

    def start(self, kind: str, least: float) -> None:
        """Begin at the least again where the values are of another kind from now on."""
        if kind != self._kind:
            self._kind = kind
            self._begin(least)


def force_arrows(force: ForceField, gain: float) -> NDArray[np.float64]:
    """Ends (N, 2, 3) of an arrow for each node in contact; it presses on the node with its tip."""
    tips = MM * force.position[force.contact]
    return _long_enough(tips - gain * NODE_MM_PER_N * force.force[force.contact], tips)


def displacement_arrows(surface: Surface, gain: float) -> NDArray[np.float64]:
    """Ends (N, 2, 3) of an arrow for each marker, from where it rests."""
    tails = MM * surface.reference.reshape(-1, 3)
    return _long_enough(tails, tails + gain * MM * surface.displacement.reshape(-1, 3))


def contact_arrow(contact: Contact, gain: float) -> NDArray[np.float64]:
    """Ends (2, 3) of the arrow of a contact's force, which ends at its centre of pressure."""
    tip = MM * contact.centre_of_pressure
    return np.stack([tip - gain * CONTACT_MM_PER_N * contact.wrench[:3], tip])


def moment_lines(
    contact: Contact, moment_point: NDArray[np.float64], gain: float
) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of the turning arrow of a contact's moment about its centre of pressure."""
    centre, wrench = contact.centre_of_pressure, contact.wrench
    moment = wrench[3:] - np.cross(centre - moment_point, wrench[:3])
    return MM * turning_arrow(centre, gain * MOMENT_MM_PER_NM / MM * moment)


def outline(contact: Contact) -> NDArray[np.float64]:
    """Sides (S, 2, 3) of a contact's boundary."""
    return MM * closed(contact.outline)


def slip_colour(state: SlipState) -> tuple[int, int, int]:
    """RGB, 0 to 255, as RViz shows it."""
    red, green, blue, _ = (round(255 * part) for part in SLIP_COLOURS[state])
    return red, green, blue


@dataclass(frozen=True)
class Ellipsoid:
    """centre (3,) mm; half axes (3,) mm; orientation, a quaternion (w, x, y, z)."""

    centre: NDArray[np.float64]
    half_axes: NDArray[np.float64]
    orientation: NDArray[np.float64]


def error_ellipsoid(contact: Contact, gain: float) -> Ellipsoid | None:
    """Where the tail of `contact_arrow` may really be, in 95 % of the cases; None if not known."""
    covariance = contact.covariance[:3, :3]
    if not (np.isfinite(covariance).all() and np.isfinite(contact.wrench).all()):
        return None
    variance, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    x, y, z, w = Rotation.from_matrix(axes).as_quat()
    half = ELLIPSOID_SIGMA * gain * CONTACT_MM_PER_N * np.sqrt(np.maximum(variance, 0.0))
    return Ellipsoid(contact_arrow(contact, gain)[0], half, np.array([w, x, y, z]))


def _long_enough(tails: NDArray[np.float64], tips: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(tips - tails, axis=-1)
    return np.asarray(np.stack([tails, tips], axis=1)[length > SHORTEST_MM])
