"""What is uncertain of all forces alike: the description's geometry, and the gel's material.

A force grows with displacement, modulus and size.  So its relative error is the gain by which its
displacement was measured, plus that of the modulus, plus those of pattern and thickness times how
much they count.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.kernels import kernel, kernel_part, plain
from cmp_tactile_processing.force.contact_regions import centre_of_forces, wrench_of
from cmp_tactile_processing.measured import Contact, ForceField, SlipEstimate, Systematics
from cmp_tactile_processing.sensor.description import SensorDescription

Array: TypeAlias = NDArray[np.float64]

# Change of the force per relative change of the pattern's size, and of the skin's modulus or
# thickness: balls that touch 1.6 to 8 mm of the sample rig's gel give -1.0 to -2.2 and at most 0.1
# (benchmarks/doubt.py).
BY_PATTERN, BY_SKIN = -2.0, 0.1
# The less gel there is beside its width, the more it is confined.  Per relative change of the
# thickness: 1.0 and 0.6 times the confinement.  Of normal forces, per change of Poisson's ratio by
# 1: -3.5 times the confinement.  At most the same balls give on gels of confinement
# 1.2: 2.0 and -3.6; 1.9: 2.2 and -7.5; 2.3: 2.8 and -12; 3.3: 3.0 and -10.
THICKNESS_ALONE, THICKNESS_BY_CONFINEMENT, POISSON_BY_CONFINEMENT = 1.0, 0.6, -3.5
# Forces that are known no better than to this share are in no certain unit.
UNCERTAIN_SCALE = 0.15


class SystematicErrors:
    """Adds to the force fields of one sensor what is uncertain of all of them."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._material, self._unit_doubtful = _material(sensor), bool(sensor.size_doubt)
        self._weighed = sensor.elastomer.calibration is not None
        self._by_thickness = by_thickness(sensor)
        self._seen: Systematics | None = None
        self._gain = self._of_force(None)
        self._scale_std = math.sqrt(self._gain[8, 8])

    def add(self, field: ForceField, seen: Systematics | None) -> ForceField:
        """The field with these errors in all its error bars.

        seen: what the reference shows of displacements.
        """
        self._look_at(seen)
        if field.force_std is None or not np.isfinite(field.wrench_covariance).all():
            return field
        force, place = field.force, field.position
        every = np.arange(len(place))
        whole = _wrench_covariance(force, place, every, self._gain)

        def wider(contact: Contact) -> Contact:
            nodes = plain(contact.nodes, np.intp)
            more = _wrench_covariance(force, place, nodes, self._gain)
            slip = self._of_slip(contact.slip)
            return replace(contact, covariance=contact.covariance + more, slip=slip)

        return replace(
            field,
            force_std=_widened(field.force_std, force, self._gain),
            wrench_covariance=field.wrench_covariance + whole,
            systematic_covariance=whole,
            contacts=tuple(wider(contact) for contact in field.contacts),
            slip=self._of_slip(field.slip),
        )

    def _of_slip(self, slip: SlipEstimate) -> SlipEstimate:
        """Friction is a ratio: what tangential and normal forces share cancels."""
        gain = self._gain
        ratio_std = math.sqrt(max(gain[0, 0] + gain[8, 8] - 2 * gain[0, 8], 0.0))
        more = ratio_std * slip.friction_coefficient
        return replace(slip, friction_std=math.hypot(slip.friction_std, more))

    @property
    def scale_is_uncertain(self) -> bool:
        """Whether the size of forces is known too badly for newtons, errors seen at rest aside."""
        return self._unit_doubtful or bool(self._scale_std > UNCERTAIN_SCALE)

    def _look_at(self, seen: Systematics | None) -> None:
        if seen is self._seen:
            return
        spread = None if seen is None else replace(seen, bias=np.zeros_like(seen.bias))
        self._scale_std = math.sqrt(self._of_force(spread)[8, 8])
        self._gain, self._seen = self._of_force(seen), seen

    def _of_force(self, seen: Systematics | None) -> Array:
        """(10, 10): of the relative error of a force, (3, 3) row by row, and of the pattern."""
        to_force = np.zeros((10, Systematics.COMPONENTS))
        to_force[:9, :9] = np.eye(9)
        to_force[:9:4, 9], to_force[9, 9] = BY_PATTERN, 1.0
        to_force[:9:4, 10] = self._by_thickness
        gain = np.zeros((10, 10))
        if seen is not None:
            # Known loads have calibrated whatever the optics leave open of the size of forces.
            moments = seen.bias if self._weighed else seen.total
            gain += to_force @ moments @ to_force.T
        gain[:9:4, :9:4] += self._material
        return gain


def material_std(sensor: SensorDescription) -> float:
    """Relative standard deviation of normal forces by what is not known of the gel."""
    return math.sqrt(_material(sensor)[2, 2])


def _material(sensor: SensorDescription) -> Array:
    """Relative covariance (3, 3) of the forces along x, y and z by what is not known of the gel."""
    record, known = sensor.elastomer.calibration, sensor.uncertainty
    if record is not None:
        along, across = record.normal_std**2, record.tangential_std**2
        return np.array([[across, across, 0.0], [across, across, 0.0], [0.0, 0.0, along]])
    common = known.of("elastomer.young") ** 2
    common += (by_thickness(sensor) * known.of("elastomer.thickness")) ** 2
    common += (BY_SKIN * known.of("elastomer.shading_layer")) ** 2
    covariance = np.full((3, 3), common)
    covariance[2, 2] += (by_poisson(sensor) * known.of("elastomer.poisson")) ** 2
    return covariance


def by_thickness(sensor: SensorDescription) -> float:
    """Relative change of a force per relative change of the gel's thickness."""
    return THICKNESS_ALONE + THICKNESS_BY_CONFINEMENT * _confinement(sensor)


def by_poisson(sensor: SensorDescription) -> float:
    """Relative change of a normal force per change of Poisson's ratio by 1."""
    return POISSON_BY_CONFINEMENT * _confinement(sensor)


def _confinement(sensor: SensorDescription) -> float:
    """Half the pattern's longer side, over the gel's thickness."""
    pattern = sensor.pattern
    side = pattern.pitch * max(pattern.rows, pattern.cols)
    return side / 2 / sensor.elastomer.size[2]


@kernel
def _wrench_covariance(force: Array, place: Array, nodes: NDArray[np.intp], gain: Array) -> Array:
    """Covariance (6, 6) of the wrench of some nodes (k,) by the gain (10, 10) of all forces.

    force (M, 3) N, place (M, 3) m: of all nodes.
    """
    wrench = wrench_of(force, place, nodes)
    centre, _ = centre_of_forces(force, place, nodes)
    # What a unit of each component adds to the wrench.
    by: Array = np.zeros((6, 10))
    for row in range(3):
        for c in range(3):
            by[row, 3 * row + c] = wrench[c]
    for k in range(9):
        _add_moment(by, k, centre)
    # What is left of the moment are pairs of forces, which grow like these.
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        pair = wrench[3 + c] - centre[a] * wrench[b] + centre[b] * wrench[a]
        for k in (0, 4, 8):
            by[3 + c, k] += pair / 3
        by[3 + c, 9] += wrench[3 + c]
    covariance: Array = by @ gain @ by.T
    return covariance


@kernel_part
def _add_moment(by: Array, k: int, centre: Array) -> None:
    """Moment of the force in column k, at the centre."""
    for c in range(3):
        a, b = (c + 1) % 3, (c + 2) % 3
        by[3 + c, k] = centre[a] * by[b, k] - centre[b] * by[a, k]


@kernel
def _widened(std: Array, force: Array, gain: Array) -> Array:
    """Standard deviations (n, 3) of forces (n, 3) with what the gain (10, 10) adds."""
    wider: Array = np.empty_like(std)
    for n in range(len(force)):
        for i in range(3):
            variance = std[n, i] ** 2
            for j in range(3):
                for k in range(3):
                    variance += force[n, j] * gain[3 * i + j, 3 * i + k] * force[n, k]
            wider[n, i] = np.sqrt(variance)
    return wider
