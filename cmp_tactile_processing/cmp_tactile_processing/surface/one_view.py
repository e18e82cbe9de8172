"""What a sensor with one view cannot tell, filled in from its known surface to be looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface import Surface
from cmp_tactile_processing.sensor.parts import PatternSurface

__all__ = ["laid_on_known_surface"]


def laid_on_known_surface(surface: Surface, known: PatternSurface) -> Surface:
    """The surface with its markers at the height of the known one, displacement along it.

    For drawing alone: no height was measured.  A surface with any depth of its own stays as it is.
    """
    if np.isfinite(surface.position[..., 2]).any():
        return surface
    position, reference = _laid(surface.position, known), _laid(surface.reference, known)
    return replace(
        surface, position=position, reference=reference, displacement=position - reference
    )


def _laid(points: NDArray[np.float64], known: PatternSurface) -> NDArray[np.float64]:
    return np.concatenate([points[..., :2], known.height(points[..., :2])[..., None]], axis=-1)
