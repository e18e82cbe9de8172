"""Photographs of any calibration board, from either side, by rays that meet its plane."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_bringup.calibration.practice import bare_views
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_simulation.rendering import Purpose, random_stream
from cmp_tactile_simulation.rendering.camera import CameraSettings, expose
from cmp_tactile_simulation.rendering.ink import DARK_GREY, HOUSING_GREY, LIGHT_GREY
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

# Samples along each side of a pixel, and greys that are kept of them for the blur.
SAMPLES, FINENESS = 4, 2
# Pixels of a square in the board's picture, and squares of white paper around it.
SQUARE_PX, PAPER = 96, 1


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
    return expose(RenderedFrame(grey, FINENESS), camera or CameraSettings(), noise, seed)


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
    # With a border of a pixel, see _sampled.
    v, u = np.mgrid[-1 : view.placement.height + 1, -1 : view.placement.width + 1]
    origins, directions = view.rays(np.stack([u, v], axis=-1))
    inwards = T_gel_board[:3, 2]
    towards = directions @ inwards
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((T_gel_board[:3, 3] - origins) @ inwards) / towards
        p_gel = origins + distance[..., None] * directions
    xy = (p_gel - T_gel_board[:3, 3]) @ T_gel_board[:3, :2]
    # Picture elements: one square of ink and the paper lie before corner (0, 0).
    uv = (xy / square + 1 + PAPER) * SQUARE_PX - 0.5
    uv[~((distance > 0) & (towards > 0))] = -1e4
    return _sampled(texture, uv.clip(-1e4, 1e5).astype(np.float32))


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
