"""The reference that displacements are measured against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import ReferenceFramesError
from cmp_tactile_processing.grid import Status
from cmp_tactile_processing.markers_3d import Markers3D
from cmp_tactile_processing.sensor_description import SensorDescription
from cmp_tactile_processing.surface import Surface

__all__ = ["Reference"]

# Markers of a gel at rest stay within this of their mean, m; ten times the usual noise of 5 um.
STILL_LIMIT = 50e-6
# Share of markers that a reference must hold.
LEAST_MARKERS = 0.5


@dataclass(frozen=True)
class Reference:
    """Marker positions (rows, cols, 3) m at rest, gel frame; NaN where none is known.

    id: 0 for the nominal surface, then counting up; stamp_ns: last frame averaged, 0 if nominal.
    """

    position: NDArray[np.float64]
    id: int = 0
    stamp_ns: int = 0

    @classmethod
    def nominal(cls, sensor: SensorDescription) -> Reference:
        """The pattern at rest as the sensor description has it."""
        return cls(sensor.pattern.corners())

    @classmethod
    def average(
        cls, markers: Sequence[Markers3D], reference_id: int, stamp_ns: int = 0
    ) -> Reference:
        """Mean of several frames of the gel at rest.

        Raises ReferenceFramesError without frames, when fewer than half of the markers were seen,
        or when they moved while the frames were taken.
        """
        if not markers:
            msg = "reference: found no frames, expected at least one"
            raise ReferenceFramesError(msg)
        stack = np.stack([item.position for item in markers])
        count = np.isfinite(stack).sum(axis=0)
        mean = np.where(count > 0, np.nansum(stack, axis=0) / np.maximum(count, 1), np.nan)
        known = float(np.isfinite(mean[..., 0]).mean())
        if known < LEAST_MARKERS:
            msg = f"reference: found {known:.0%} of the markers, expected {LEAST_MARKERS:.0%}"
            raise ReferenceFramesError(msg)
        off = np.linalg.norm((stack - mean)[..., :2], axis=-1)
        moved = float(np.median(np.nanmax(off[:, count[..., 0] > 0], axis=0)))
        if moved > STILL_LIMIT:
            msg = (
                f"reference: found markers moving by {moved * 1e6:.0f} um, "
                f"expected a gel at rest (at most {STILL_LIMIT * 1e6:.0f} um)"
            )
            raise ReferenceFramesError(msg)
        return cls(mean, reference_id, stamp_ns)

    def surface(self, markers: Markers3D) -> Surface:
        """Displacement of the markers; missing where either position or reference is."""
        displacement = markers.position - self.position
        lost = np.isnan(displacement[..., :2]).any(axis=-1)
        status = np.where(lost, Status.MISSING, markers.status).astype(np.uint8)
        return Surface(
            shape=markers.shape,
            reference=self.position,
            position=markers.position,
            displacement=displacement,
            status=status,
            fault=markers.fault,
            covariance=markers.covariance,
            ray_gap=markers.ray_gap,
            row_position=markers.row_position,
            row_status=markers.row_status,
            row_std=markers.row_std,
            col_position=markers.col_position,
            col_status=markers.col_status,
            col_std=markers.col_std,
            reference_id=self.id,
            reference_stamp_ns=self.stamp_ns,
        )
