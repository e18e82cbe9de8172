"""What hides or surrounds the pattern in a frame: housing, lamps, and things in front of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.measured import Grid
from cmp_tactile_simulation.rendering.ink import HOUSING_GREY
from cmp_tactile_simulation.rendering.renderer import RenderedFrame

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Sides of a part and spread of a lamp's light, px of the frame; light of a lamp, grey levels.
PART_SIDES = (20.0, 130.0), (8.0, 45.0)
LAMP_SPREAD = (5.0, 9.0)
LAMP_LIGHT = 600.0
PART_GREYS = (5.0, 245.0)
# The housing is the darkest of what is rendered; a rim of it is mixed with the skin.
RIM = 1.0


@dataclass(frozen=True)
class Scenery:
    """Number of flat parts on the housing next to the skin, and of lamps there."""

    parts: int = 0
    lamps: int = 0

    def paint(
        self, grey: NDArray[np.float32], fineness: int, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The rendered greys with parts and lamps where the housing was seen."""
        if not (self.parts or self.lamps):
            return grey
        housing = np.abs(grey - HOUSING_GREY) < RIM
        places = np.argwhere(housing[::8, ::8]) * 8
        if not len(places):
            return grey
        scene = grey.copy()
        for _ in range(self.parts):
            v, u = places[rng.integers(len(places))]
            sides = [rng.uniform(*limits) * fineness for limits in PART_SIDES]
            box = cv2.boxPoints(((float(u), float(v)), tuple(sides), float(rng.uniform(0, 180))))
            cv2.fillConvexPoly(
                scene, np.rint(box).astype(np.int32), float(rng.uniform(*PART_GREYS))
            )
        scene = np.where(housing, scene, grey)
        for _ in range(self.lamps):
            v, u = places[rng.integers(len(places))]
            spread = rng.uniform(*LAMP_SPREAD) * fineness
            down = np.exp(-((np.arange(grey.shape[0]) - v) ** 2) / (2 * spread**2))
            across = np.exp(-((np.arange(grey.shape[1]) - u) ** 2) / (2 * spread**2))
            scene += (LAMP_LIGHT * np.outer(down, across)).astype(np.float32)
        return np.asarray(scene, dtype=np.float32)


Box = tuple[float, float, float, float]
INF = float("inf")


def _boxes(share: float) -> dict[str, tuple[Box, ...]]:
    """What the shapes with straight sides cover: boxes (left, right, top, bottom).

    Places are 0 to 1 between the pattern's sides in the image, less and more beyond them.
    """
    left, right = (-INF, share, -INF, INF), (1 - share, INF, -INF, INF)
    top, bottom = (-INF, INF, -INF, share), (-INF, INF, 1 - share, INF)
    low, high = (1 - share) / 2, (1 + share) / 2
    return {
        "left": (left,),
        "right": (right,),
        "top": (top,),
        "bottom": (bottom,),
        "left_top": (left, top),
        "right_bottom": (right, bottom),
        "band_across": ((-INF, INF, low, high),),
        "band_down": ((low, high, -INF, INF),),
    }


COVERS = (*_boxes(0.5), "disc")
# A corner is far from what hides others at so many sides of its checkers.
FAR_CELLS = 2.0
# Centre of the disc, between the pattern's sides.
DISC_AT = 0.55, 0.45
# Grains of the texture, px.
GRAIN = 3.0


@dataclass(frozen=True)
class Cover:
    """An opaque thing in front of each view.

    shape: one of COVERS.  share: part of the pattern's width, height or diameter that it hides.
    grey: 0 to 255, where light skin is 205 and dark ink 45.  texture: standard deviation of its
    grey.  Raises InputError for another shape.
    """

    shape: str = "left"
    share: float = 1 / 3
    grey: float = 110.0
    texture: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in COVERS:
            msg = f"cover.shape: found {self.shape!r}, expected one of {', '.join(COVERS)}"
            raise InputError(msg)

    def mask(self, corners: Array, size: tuple[int, int], fineness: int = 1) -> Flags:
        """What it hides of a view of that size (height, width), each pixel cut in fineness^2.

        corners (..., 2) px of the view: the pattern's true corners, NaN where there is none.
        """
        low, high = (pick(corners.reshape(-1, 2), axis=0) for pick in (np.nanmin, np.nanmax))
        x, y = (
            ((np.arange(count * fineness) + 0.5) / fineness - 0.5 - start)
            for count, start in zip(size[::-1], low, strict=True)
        )
        width, height = (float(extent) for extent in high - low)
        if self.shape == "disc":
            radius = self.share * min(width, height) / 2
            across, down = x - DISC_AT[0] * width, y[:, None] - DISC_AT[1] * height
            return np.asarray(across**2 + down**2 < radius**2)
        mask = np.zeros((len(y), len(x)), np.bool_)
        u, v = x / width, y[:, None] / height
        for left, right, top, bottom in _boxes(self.share)[self.shape]:
            mask |= (u > left) & (u < right) & (v > top) & (v < bottom)
        return mask

    def greys(self, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
        """Its greys, everywhere in an image of that shape."""
        if self.texture == 0:
            return np.full(shape, self.grey, dtype=np.float32)
        noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), GRAIN)
        greys = self.grey + noise * (self.texture / float(noise.std()))
        return np.asarray(greys.clip(0, 255), dtype=np.float32)


def cover_views(
    rendered: RenderedFrame, truth: Mapping[str, Grid], cover: Cover, rng: np.random.Generator
) -> tuple[RenderedFrame, dict[str, Flags]]:
    """The frame with the cover in front of each view, and what it hides of them (height, width)."""
    fineness, masks = rendered.fineness, {}
    painted = rendered.grey.copy()
    for name, grid in truth.items():
        place = grid.placement
        if place is None:
            continue
        size = place.height, place.width
        rows = slice(place.y * fineness, (place.y + place.height) * fineness)
        part = painted[rows, place.x * fineness : (place.x + place.width) * fineness]
        part = part[:, ::-1] if place.flipped else part
        mask = cover.mask(grid.corners, size, fineness)
        part[mask] = cover.greys((part.shape[0], part.shape[1]), rng)[mask]
        masks[name] = cover.mask(grid.corners, size)
    return replace(rendered, grey=painted), masks


def far_corners(corners: Array, covered: Flags) -> Flags:
    """Which of the corners (rows, cols, 2) px lie FAR_CELLS checkers from what is covered.

    covered: mask of the view, (height, width), or empty where nothing is.
    """
    far = np.isfinite(corners[..., 0])
    if not covered.any():
        return far
    steps = [np.linalg.norm(np.gradient(corners, axis=axis), axis=-1) for axis in (0, 1)]
    side = np.fmax(*steps)
    distance = cv2.distanceTransform((~covered).astype(np.uint8), cv2.DIST_L2, 5)
    x, y = pixels_of(corners, covered.shape)
    return np.asarray(far & (distance[y, x] >= FAR_CELLS * side))


def far_from_edge(corners: Array, size: tuple[int, int]) -> Flags:
    """Which corners (rows, cols, 2) px lie FAR_CELLS checkers within a view of (height, width)."""
    beyond = np.pad(np.zeros(size, np.bool_), 1, constant_values=True)
    return far_corners(corners + 1, beyond)


def pixels_of(corners: Array, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The pixels of corners, (0, 0) where there is none."""
    q = np.rint(np.nan_to_num(corners)).clip(0, np.array(shape[1::-1]) - 1).astype(np.intp)
    return q[..., 0], q[..., 1]
