"""Collects the frames that a new reference is averaged from."""

from __future__ import annotations

import numpy as np
from rclpy.task import Future

from cmp_tactile_processing.displacement import Reference
from cmp_tactile_processing.grid import GridShape, Status
from cmp_tactile_processing.markers_3d import Markers3D
from cmp_tactile_processing.surface import Surface

__all__ = ["ReferenceAveraging", "surface_at_rest"]


class ReferenceAveraging:
    """Takes `wanted` frames; `outcome` becomes (success, explanation) once they are used."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.markers: list[Markers3D] = []
        self.outcome: Future[tuple[bool, str]] = Future()

    def add(self, markers: Markers3D) -> bool:
        """Whether this frame was the last one needed."""
        self.markers.append(markers)
        return len(self.markers) == self.wanted

    def finish(self, success: bool, explanation: str) -> None:
        """Settle the outcome; a second time changes nothing."""
        if not self.outcome.done():
            self.outcome.set_result((success, explanation))


def surface_at_rest(reference: Reference, shape: GridShape) -> Surface:
    """The surface whose markers all are where the reference has them; no virtual markers."""
    position = reference.position
    known = np.isfinite(position[..., :2]).all(axis=-1)
    return Surface(
        shape=shape,
        reference=position,
        position=position,
        displacement=position - position,
        status=np.where(known, Status.MEASURED, Status.MISSING).astype(np.uint8),
        ray_gap=np.full(shape.corners, np.nan),
        row_position=np.full((*shape.row_lines, 3), np.nan),
        col_position=np.full((*shape.col_lines, 3), np.nan),
        reference_id=reference.id,
        reference_stamp_ns=reference.stamp_ns,
    )
