"""What no gel of a sensor's description can show: then the markers are wrong, not the gel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import Pattern

__all__ = ["Plausibility"]

# How far a marker may move, over the thickness of the gel at the apex.  The base does not give way,
# so nothing is pressed deeper than to it.  A gel that is described as linear has no such end: by
# its law small indenters and scaled loads of 50 N reach 1.7, and their force is what was put on.
FARTHEST, FARTHEST_LINEAR = 1.0, 2.0
# Markers that hardly sink stay in their order: presses, drags and twists as far as friction holds
# change their distance along the line that joins them to 0.5 to 1.6 of what it was.  Markers that
# change places have 0 or less, and a marker that is taken for the next one leaves 2 on its other
# side.  Deeper in, steep flanks part them farther.
MOST_CHANGED, SHALLOW = 0.8, 0.15
# What no force explains, over the distance of the markers: of all together (root mean square), and
# between two neighbours.  Contacts leave 0.01, hand-made fields that no gel shows 0.03; a numbering
# that is off by one leaves 0.1 to 0.4 of the whole, and up to 1 where it begins.
UNEXPLAINED, UNEXPLAINED_STEP = 0.1, 1 / 3
# A gel that is bonded to its base tears open inside at a tension of 5/6 of Young's modulus (Gent
# and Lindley 1958), and what holds on to it by suction lets go at the pressure of the air.
TEARS_AT, AIR_PA = 5 / 6, 101325.0


class Plausibility:
    """Judges displacements and forces by limits that follow from one sensor's description.

    markers: the grid of the markers.
    """

    def __init__(self, sensor: SensorDescription, markers: SurfaceGrid) -> None:
        elastomer, pattern = sensor.elastomer, sensor.pattern
        thickness = elastomer.size[2]
        linear = elastomer.model == "linear"
        self._farthest = thickness * (FARTHEST_LINEAR if linear else FARTHEST)
        self._shallow = thickness * SHALLOW
        self._pitch = pattern.pitch
        rest = _rest(pattern, markers)
        apart = rest[1:] - rest[:-1], rest[:, 1:] - rest[:, :-1]
        self._directions = [step / (step**2).sum(axis=-1, keepdims=True) for step in apart]
        area = float(np.prod(markers.extent))
        # Gent's stiffness of a bonded layer: pressed on all over, it gives way all through at this.
        wide = np.sqrt(area) / (4 * thickness)
        self._most_pressed = elastomer.young * (1 + 2 * wide**2) * area
        self._most_pulled = min(TEARS_AT * elastomer.young, AIR_PA) * area

    def allows_displacement(self, moved: NDArray[np.float64]) -> bool:
        """Whether a gel can move so: moved (rows, cols, 3) m, NaN where not known."""
        # Of one view the depth is not known, nor is it needed here.
        depth = np.where(np.isnan(moved[..., 2]), 0.0, moved[..., 2])
        # Without the depth steep flanks are not known either: only what changes places is refused.
        most = 1.0 if np.isnan(moved[..., 2]).all() else MOST_CHANGED
        flat = np.dstack([moved[..., :2], depth])
        if ((flat**2).sum(axis=-1) > self._farthest**2).any():
            return False
        sunk = np.abs(depth) > self._shallow
        either = sunk[1:] | sunk[:-1], sunk[:, 1:] | sunk[:, :-1]
        steps = flat[1:] - flat[:-1], flat[:, 1:] - flat[:, :-1]
        for direction, step, deep in zip(self._directions, steps, either, strict=True):
            change = np.abs((step * direction).sum(axis=-1))
            if ((change > most) & ~deep).any():
                return False
        return True

    def allows_force(self, force: NDArray[np.float64], unexplained: NDArray[np.float64]) -> bool:
        """Whether a gel can bear forces (nodes, 3) N that leave so much of its motion open.

        unexplained (rows, cols, 3) m: displacement beyond what the forces explain, NaN where not
        known.
        """
        if np.isnan(unexplained[..., 2]).all():
            # Of one view the forces are inferred: what is open about them is in their deviations.
            return True
        pulled = np.maximum(force[:, 2], 0.0).sum()
        pressed = np.maximum(-force[:, 2], 0.0).sum()
        if pulled > self._most_pulled or pressed > self._most_pressed:
            return False
        known = unexplained[np.isfinite(unexplained)]
        if float(known @ known) > (UNEXPLAINED * self._pitch) ** 2 * len(known):
            return False
        flat, most = unexplained[..., :2], UNEXPLAINED_STEP * self._pitch
        steps = flat[1:] - flat[:-1], flat[:, 1:] - flat[:, :-1]
        return not any((np.abs(step) > most).any() for step in steps)


def _rest(pattern: Pattern, markers: SurfaceGrid) -> NDArray[np.float64]:
    """Markers at rest, (rows, cols, 3) m."""
    points = markers.points
    height = pattern.surface.height(points)
    return np.column_stack([points, height]).reshape(markers.rows, markers.cols, 3)
