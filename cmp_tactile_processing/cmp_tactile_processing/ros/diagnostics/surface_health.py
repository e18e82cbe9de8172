"""What the markers of the last second say of the sensor, for the triangulator's diagnostics."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.measured.markers_3d import MarkerFault, Markers3D
from cmp_tactile_processing.stereo.reprojection import reprojection_rms

__all__ = ["SurfaceHealth"]


class SurfaceHealth:
    """Gathers markers; `close_period` tells of those that came since the last call."""

    def __init__(self, views: Mapping[str, ViewGeometry]) -> None:
        self._views = views
        self._last: tuple[Markers3D, Mapping[str, Grid]] | None = None
        self._begin()

    def _begin(self) -> None:
        self._last = None
        self._frames = self._implausible = 0
        self._doubt = ""

    def add(self, markers: Markers3D, grids: Mapping[str, Grid], doubt: str) -> None:
        """Take a frame into account; doubt: why it is implausible, empty where it is not."""
        self._last = markers, grids
        self._frames += 1
        if doubt:
            self._implausible += 1
            self._doubt = doubt

    def close_period(self) -> tuple[str, dict[str, str]]:
        """Doubt, empty where there is none, and figures; those of markers are the last frame's."""
        figures = {"implausible frames": f"{self._implausible} of {self._frames}"}
        if self._last is not None:
            markers, grids = self._last
            gaps = markers.ray_gap[np.isfinite(markers.ray_gap)]
            gap = float(np.median(gaps)) if gaps.size else math.nan
            rms = reprojection_rms(markers, grids, self._views)
            figures |= {
                "tracked fraction": f"{np.mean(markers.status == Status.MEASURED):.4f}",
                "markers without position": _counts(markers),
                "median ray gap (um)": f"{gap * 1e6:.2f}",
                "reprojection (px)": f"{rms:.3f}",
            }
        doubt = self._doubt
        self._begin()
        return doubt, figures


def _counts(markers: Markers3D) -> str:
    faults = [fault for fault in MarkerFault if fault is not MarkerFault.NONE]
    counts = {fault.name.lower(): np.count_nonzero(markers.fault == fault) for fault in faults}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count) or "none"
