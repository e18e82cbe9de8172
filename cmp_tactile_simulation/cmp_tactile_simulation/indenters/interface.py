"""What the contact solver needs to know of a rigid indenter."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_simulation.errors import IndenterError

__all__ = ["MAX_SIZE", "MIN_SIZE", "Indenter", "check_length"]

# Lengths outside of this range, m, are taken for a mistake in the unit.
MIN_SIZE, MAX_SIZE = 1e-6, 0.2


class Indenter(Protocol):
    """A rigid solid in its own frame, m: unturned, its -z side faces the gel.

    The origin is the indenter's reference point: forces' torques are about it.  It is the centre
    of the solid's bounding box, but the middle of the tip of a flat probe, and the given origin
    of a group of spheres.
    """

    @property
    def name(self) -> str:
        """What messages call the indenter."""

    @property
    def feature(self) -> float:
        """Smallest radius of curvature of the surface, m: no step may be much longer."""

    @property
    def reach(self) -> float:
        """Radius of a sphere about the origin that holds the whole solid, m."""

    def distance(
        self, p_indenter: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance (k,) m of points (k, 3), negative inside, and outward normals (k, 3).

        The normal is the indenter's at the surface point nearest to the point, a unit vector.
        """


def check_length(owner: str, value: float, low: float = MIN_SIZE, high: float = MAX_SIZE) -> None:
    """Raise IndenterError for a length outside low..high, m; `owner` names shape and key."""
    if not low <= value <= high:
        msg = f"{owner}: found {value!r} m, expected {low:.6g} to {high:.6g} m"
        raise IndenterError(msg)
