"""What a force is off where displacements count from the description: no gel is just as described.

A gel that is off by less than `rest.rest_tolerance` looks as described to everybody.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.stillness import RestParameters

Float = NDArray[np.float64]

# Of a value within a range of 1, each as likely.
STD_OF_RANGE = 1 / math.sqrt(12)


def errors_without_reference(sensor: SensorDescription, nodes: int) -> tuple[Float, Float]:
    """Covariance (6, 6) of the wrench, and standard deviations (nodes, 3) N.

    They are the forces that shift the whole pattern so far: of a block that is bonded to its base
    (Gent, "On the relation between indentation hardness and Young's modulus", 1958, for its
    compression).
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
