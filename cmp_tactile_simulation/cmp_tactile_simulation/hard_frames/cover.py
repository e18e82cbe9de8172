"""Things between gel and camera that hide a part of the pattern."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ParameterError

__all__ = ["COVERS", "Cover"]

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
# Centre of the disc, between the pattern's sides.
DISC_AT = 0.55, 0.45
# Grains of the texture, px.
GRAIN = 3.0


@dataclass(frozen=True)
class Cover:
    """An opaque thing in front of each view.

    shape: one of COVERS.  share: part of the pattern's width, height or diameter that it hides.
    grey: 0 to 255, where light skin is 205 and dark ink 45.  texture: standard deviation of its
    grey.  Raises ParameterError for another shape.
    """

    shape: str = "left"
    share: float = 1 / 3
    grey: float = 110.0
    texture: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in COVERS:
            msg = f"cover.shape: found {self.shape!r}, expected one of {', '.join(COVERS)}"
            raise ParameterError(msg)

    def mask(
        self, corners: NDArray[np.float64], size: tuple[int, int], fineness: int = 1
    ) -> NDArray[np.bool_]:
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
