"""What pixels do not show of a force's errors: readout of the camera, codec, absent reference."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.measured import ForceField
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.stillness import RestParameters

Float = NDArray[np.float64]

# Of a value that is somewhere within a range of 1, each place as likely.
STD_OF_RANGE = 1 / math.sqrt(12)
# What speeds up evenly from rest is at the end twice as fast as on average.
FASTEST = 2.0


class RollingShutter:
    """Adds to the error bars of one sensor's force fields what changed during the readout.

    The rows of a contact are exposed up to half the readout time before or after the frame's
    middle.  The change since the frame before shows how fast the force changes: as of a movement
    that began there.
    """

    def __init__(self, readout_time: float) -> None:
        """readout_time: from the first row to the last, s; 0: all rows at once."""
        self._readout_time = readout_time
        self._before: tuple[ForceField, int] | None = None

    def reset(self) -> None:
        """Forget the frame before."""
        self._before = None

    def add(self, field: ForceField, stamp_ns: int | None) -> ForceField:
        """The field of the frame that was taken then, with wider error bars where it moves."""
        if not self._readout_time:
            return field
        before = self._before
        known = stamp_ns is not None and np.isfinite(field.wrench).all()
        self._before = (field, stamp_ns) if known and stamp_ns is not None else None
        if before is None or self._before is None:
            return field
        since = (self._before[1] - before[1]) * 1e-9
        if since <= 0:
            return field
        share = FASTEST * STD_OF_RANGE * self._readout_time / since
        wrench = share * (field.wrench - before[0].wrench)
        nodes = share * (field.force - before[0].force)
        return field.with_systematic_errors(np.outer(wrench, wrench), nodes)


def errors_without_reference(sensor: SensorDescription, nodes: int) -> tuple[Float, Float]:
    """Covariance (6, 6) of the wrench, and standard deviations (nodes, 3) N.

    Displacements that count from the description: no gel is just as described, and one that is off
    by less than `rest.rest_tolerance` looks so.  These forces shift the whole pattern so far: of a
    block that is bonded to its base (Gent, "On the relation between indentation hardness and
    Young's modulus", 1958, for its compression).
    """
    gel, pattern = sensor.elastomer, sensor.pattern
    sides = pattern.pitch * np.array([pattern.cols, pattern.rows])
    thickness = gel.size[2]
    shape_factor = float(np.prod(sides) / (2 * thickness * sides.sum()))
    normal = gel.young * (1 + 2 * shape_factor**2)
    moduli = np.array([*2 * [gel.young / (2 * (1 + gel.poisson))], normal])
    off = STD_OF_RANGE * RestParameters().rest_tolerance
    force = moduli * np.prod(sides) * off / thickness
    # Their place is anywhere on the pattern.
    arms = STD_OF_RANGE * sides[::-1]
    moment = np.array([force[2] * arms[0], force[2] * arms[1], force[0] * arms.max()])
    covariance = np.diag(np.concatenate([force, moment]) ** 2)
    return covariance, np.tile(force / nodes, (nodes, 1))
