"""What a camera sees beside the gel: parts of the housing, lamps."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.rendering.ink import HOUSING_GREY

__all__ = ["Scenery"]

# Sides of a part and spread of a lamp's light, px of the frame; light of a lamp, grey levels.
PART_SIDES = (20.0, 130.0), (8.0, 45.0)
LAMP_SPREAD = (5.0, 9.0)
LAMP_LIGHT = 600.0
PART_GREYS = (5.0, 245.0)
# The housing is the darkest of what is rendered; a rim of it is mixed with the skin.
RIM = 1.0


@dataclass(frozen=True)
class Scenery:
    """Number of flat parts that lie on the housing beside the skin, and of lamps there."""

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
