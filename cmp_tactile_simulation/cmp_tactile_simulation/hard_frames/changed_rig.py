"""Rigs as they are built, unlike their description by a known size, and their board images."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.errors import CalibrationError, DescriptionError
from cmp_tactile_processing.geometry.optics import ViewGeometry, build_views
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Camera, Mirror, ViewDescription
from cmp_tactile_simulation.errors import SimulationError
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import DARK_GREY, HOUSING_GREY, LIGHT_GREY
from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream
from cmp_tactile_simulation.rendering.renderer import RenderedFrame, pixel_rays

# Directions of the changes are drawn so often until the pattern lies in all views.
MOST_DRAWS = 200
# The pattern keeps this distance from the sides of its view, in checkers.
MARGIN_CHECKERS = 1.5
# Samples along each side of a pixel, and greys that are kept of them for the blur.
SAMPLES, FINENESS = 4, 2
# Pixels of a square in the board's picture, and squares of white paper around it.
SQUARE_PX, PAPER = 96, 1
# How far boards lean, rad, and lie off the gel's middle, in sides of the pattern.
LEAN, OFF_CENTRE, OFF_HEIGHT = 0.7, 0.25, 0.35
# Corners nearer than this to a view's border, px, are not counted on.
MARGIN_PX = 8.0
TRIES = 2000
# Directions are worked out this many px apart; a cubic spline between is right to 1e-6 px.
RAY_STEP_PX = 8


def changed_rig(  # noqa: PLR0913, PLR0917 - one keyword for each thing that is changed
    sensor: SensorDescription,
    seed: int,
    turn: float = math.radians(1.0),
    shift: float = 0.5e-3,
    focal: float = 0.01,
    principal_point: float = 0.0,
) -> SensorDescription:
    """The sensor with gel, mirrors and camera changed by exactly that much in random directions.

    turn: rad, of the gel about any axis and of each mirror's plane about the foot point of the
    camera on it.  shift: m, of the gel along any direction and of each mirror along its normal.
    focal: relative, of fx and fy alike.  principal_point: px, in any direction.  Of a two_view
    sensor, each view's pose and camera.  The whole pattern at rest stays in all views.
    Raises SimulationError where no direction leaves it there.
    """
    rng = random_stream(Purpose.CHANGED_RIG, seed)
    sizes = {"turn": turn, "shift": shift, "focal": focal, "principal_point": principal_point}
    for _ in range(MOST_DRAWS):
        changed = _drawn(sensor, sizes, rng)
        if _shows_all(changed):
            return changed
    msg = (
        f"{sensor.name}: found no change by {math.degrees(turn):g} degrees, {shift * 1e3:g} mm and "
        f"{focal:.3g} in focal length that leaves the pattern in all views"
    )
    raise SimulationError(msg)


def _drawn(
    sensor: SensorDescription, sizes: Mapping[str, float], rng: np.random.Generator
) -> SensorDescription:
    optics, camera = sensor.optics, sensor.camera
    if optics.T_camera_gel is not None:
        optics = replace(optics, T_camera_gel=_moved(optics.T_camera_gel, sizes, rng))
    if camera is not None and optics.type != "two_view":
        camera = _changed_camera(camera, sizes, rng)
    views = {name: _changed_view(view, sizes, rng) for name, view in sensor.views.items()}
    return replace(sensor, optics=optics, camera=camera, views=views, calibration=None)


def _changed_view(
    view: ViewDescription, sizes: Mapping[str, float], rng: np.random.Generator
) -> ViewDescription:
    if view.mirror is not None:
        view = replace(view, mirror=_changed_mirror(view.mirror, sizes, rng))
    if view.T_view_gel is not None:
        view = replace(view, T_view_gel=_moved(view.T_view_gel, sizes, rng))
    if view.camera is not None:
        view = replace(view, camera=_changed_camera(view.camera, sizes, rng))
    return view


def _changed_camera(camera: Camera, sizes: Mapping[str, float], rng: np.random.Generator) -> Camera:
    scale = 1 + sizes["focal"] * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0, 2 * math.pi)
    return replace(
        camera,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=camera.cx + sizes["principal_point"] * math.cos(angle),
        cy=camera.cy + sizes["principal_point"] * math.sin(angle),
    )


def _changed_mirror(mirror: Mirror, sizes: Mapping[str, float], rng: np.random.Generator) -> Mirror:
    axis = np.cross(mirror.normal, _unit(rng))
    axis /= np.linalg.norm(axis)
    normal = Rotation.from_rotvec(sizes["turn"] * axis).apply(mirror.normal)
    normal /= np.linalg.norm(normal)
    return Mirror(normal, mirror.distance + sizes["shift"] * float(rng.choice([-1.0, 1.0])))


def _moved(
    T: NDArray[np.float64], sizes: Mapping[str, float], rng: np.random.Generator
) -> NDArray[np.float64]:
    """T (4, 4) after the gel turned about its apex and shifted."""
    turn, shift = sizes["turn"] * _unit(rng), sizes["shift"] * _unit(rng)
    moved = np.eye(4)
    moved[:3, :3] = (Rotation.from_matrix(T[:3, :3]) * Rotation.from_rotvec(turn)).as_matrix()
    moved[:3, 3] = T[:3, 3] + T[:3, :3] @ shift
    return moved


def _unit(rng: np.random.Generator) -> NDArray[np.float64]:
    direction = rng.standard_normal(3)
    return np.asarray(direction / np.linalg.norm(direction))


def _shows_all(sensor: SensorDescription) -> bool:
    try:
        views = build_views(sensor).values()
    except DescriptionError:
        return False
    for view in views:
        q = view.project(sensor.pattern.corners())
        side = max(float(np.abs(np.diff(q, axis=axis)).max()) for axis in (0, 1))
        limit = np.array([view.placement.width, view.placement.height]) - 1
        margin = MARGIN_CHECKERS * side
        if not ((q > margin) & (q < limit - margin)).all():
            return False
    return True


def bare_views(sensor: SensorDescription) -> dict[str, ViewGeometry]:
    """The sensor's views without gel and plate: straight rays."""
    return build_views(replace(sensor, optics=replace(sensor.optics, layers=())))


def photograph_board(
    sensor: SensorDescription,
    target: BoardTarget,
    T_gel_board: NDArray[np.float64],
    camera: CameraSettings | None = None,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The frame (height, width) uint8 of a board in all views; the gel is not mounted.

    T_gel_board (4, 4): board frame (BoardTarget) -> gel frame.  camera: default CameraSettings().
    seed: of noise and dirt.  The board is printed on white paper that reaches a square beyond it,
    and is grey from behind.
    """
    image = sensor.image
    grey = np.full((image.height * FINENESS, image.width * FINENESS), HOUSING_GREY, np.float32)
    texture = _texture(target)
    for view in bare_views(sensor).values():
        place = view.placement
        rows = slice(place.y * FINENESS, (place.y + place.height) * FINENESS)
        part = grey[rows, place.x * FINENESS : (place.x + place.width) * FINENESS]
        part = part[:, ::-1] if place.flipped else part
        part[:] = _seen(view, texture, target.square, T_gel_board)
    noise = random_stream(Purpose.FRAME_NOISE, seed)
    return expose([RenderedFrame(grey, FINENESS)], camera or CameraSettings(), noise, seed)


def board_poses(
    sensor: SensorDescription, target: BoardTarget, count: int, seed: int = 0
) -> list[NDArray[np.float64]]:
    """Poses T_gel_board (4, 4) that show the whole board in all views, leaning to all sides.

    Raises CalibrationError where the board is too large for the views.
    """
    rng, views = np.random.default_rng(seed), list(bare_views(sensor).values())
    pattern = sensor.pattern
    reach = pattern.pitch * (max(pattern.rows, pattern.cols) - 1)
    poses: list[NDArray[np.float64]] = []
    for _ in range(TRIES):
        T_gel_board = _random_pose(target, reach, rng)
        points = target.points @ T_gel_board[:3, :3].T + T_gel_board[:3, 3]
        if all(_shows(view, points, T_gel_board[:3, 2]) for view in views):
            poses.append(T_gel_board)
            if len(poses) == count:
                return poses
    msg = (
        f"{target}: found {len(poses)} of {count} poses within all views, expected smaller squares"
    )
    raise CalibrationError(msg)


def _random_pose(
    target: BoardTarget, reach: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """A board about the gel's middle, its front towards the cameras below."""
    towards = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(towards), np.sin(towards), 0.0])
    lean = Rotation.from_rotvec(axis * LEAN * np.sqrt(rng.uniform()))
    turn = Rotation.from_euler("z", rng.uniform(-0.3, 0.3) + np.pi * rng.integers(2))
    T = np.eye(4)
    T[:3, :3] = (lean * turn).as_matrix()
    offset = rng.uniform(-1, 1, 3) * reach * (OFF_CENTRE, OFF_CENTRE, OFF_HEIGHT)
    T[:3, 3] = offset - T[:3, :3] @ target.points.mean(axis=0)
    return T


def _shows(view: ViewGeometry, points: NDArray[np.float64], inwards: NDArray[np.float64]) -> bool:
    """Whether a view sees all points on the front of a board, well within its borders."""
    if ((points - view.centre) @ inwards <= 0).any():
        return False
    q = view.project(points)
    last = np.array([view.placement.width, view.placement.height]) - 1.0
    return bool(((q >= MARGIN_PX) & (q <= last - MARGIN_PX)).all())


@lru_cache(maxsize=2)
def _texture(target: BoardTarget) -> NDArray[np.float32]:
    """Greys of the board and its paper, SQUARE_PX to a square."""
    ink = target.picture(SQUARE_PX).astype(np.float32) / 255
    paper = np.pad(ink, PAPER * SQUARE_PX, constant_values=1.0)
    return np.asarray(DARK_GREY + (LIGHT_GREY - DARK_GREY) * paper, dtype=np.float32)


def _seen(
    view: ViewGeometry,
    texture: NDArray[np.float32],
    square: float,
    T_gel_board: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Greys of a view, FINENESS x FINENESS for each pixel."""
    directions, inwards = _directions(view), T_gel_board[:3, 2]
    towards = directions @ inwards
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((T_gel_board[:3, 3] - view.centre) @ inwards) / towards
        p_gel = view.centre + distance[..., None] * directions
    xy = (p_gel - T_gel_board[:3, 3]) @ T_gel_board[:3, :2]
    # Picture elements: one square of ink and the paper lie before corner (0, 0).
    uv = (xy / square + 1 + PAPER) * SQUARE_PX - 0.5
    uv[~((distance > 0) & (towards > 0))] = -1e4
    uv = uv.clip(-1e4, 1e5)
    height, width = uv.shape[0] - 2, uv.shape[1] - 2
    greys = np.full((height * FINENESS, width * FINENESS), HOUSING_GREY, np.float32)
    last = np.array(texture.shape[::-1], np.float32) + SQUARE_PX
    shown = np.asarray(((uv > -SQUARE_PX) & (uv < last)).all(axis=-1))[1:-1, 1:-1]
    if not shown.any():
        return greys
    # Only where the board is, with a pixel more all around to interpolate from.
    v, u = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    rows, cols = slice(v[0], v[-1] + 1), slice(u[0], u[-1] + 1)
    around = uv[rows.start : rows.stop + 2, cols.start : cols.stop + 2].astype(np.float32)
    fine_rows, fine_cols = (slice(s.start * FINENESS, s.stop * FINENESS) for s in (rows, cols))
    greys[fine_rows, fine_cols] = _sampled(texture, around)
    return greys


def _sampled(texture: NDArray[np.float32], uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Greys within pixels, FINENESS x FINENESS each, of which those at the border are left out.

    uv (h + 2, w + 2, 2): place of each pixel's centre in the texture.
    """
    size = uv.shape[1] * SAMPLES, uv.shape[0] * SAMPLES
    fine = cv2.resize(uv, size, interpolation=cv2.INTER_LINEAR)[SAMPLES:-SAMPLES, SAMPLES:-SAMPLES]
    greys = cv2.remap(
        texture,
        np.ascontiguousarray(fine),
        np.empty(0, np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(HOUSING_GREY),
    )
    size = greys.shape[1] * FINENESS // SAMPLES, greys.shape[0] * FINENESS // SAMPLES
    return np.asarray(cv2.resize(greys, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _directions(view: ViewGeometry) -> NDArray[np.float64]:
    """Directions (height + 2, width + 2, 3), gel frame, of all pixels and one more all around.

    NaN for pixels to which the lens brings no light.
    """
    width, height = view.placement.width, view.placement.height
    y, x = (
        np.linspace(-1, side, max(side // RAY_STEP_PX, 4) + 1, dtype=np.float64)
        for side in (height, width)
    )
    lattice = np.stack(np.meshgrid(x, y), axis=-1)
    _, known = view.rays(lattice.reshape(-1, 2))
    if not np.isfinite(known).all():
        # A spline would spread what is missing over all pixels.
        return pixel_rays(view)[1]
    rows, cols = np.arange(-1.0, height + 1), np.arange(-1.0, width + 1)
    directions = np.empty((height + 2, width + 2, 3))
    for axis, values in enumerate(known.reshape(*lattice.shape[:2], 3).transpose(2, 0, 1)):
        directions[..., axis] = RectBivariateSpline(y, x, values)(rows, cols)
    return directions
