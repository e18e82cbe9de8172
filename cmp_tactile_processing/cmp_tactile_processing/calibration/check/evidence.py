"""What a recording shows: grids of its views, markers in space, how well they agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.check.parameters import CheckParameters
from cmp_tactile_processing.calibration.check.rest import (
    RigidDrift,
    rest_frames,
    rigid_drift,
)
from cmp_tactile_processing.calibration.observation import observed
from cmp_tactile_processing.calibration.outcome import ViewResiduals
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig

__all__ = ["CheckedRecording"]

# Gaps are what is looked for: no marker is left out for its gap, m.
WIDEST_GAP_M = 1e-2


class CheckedRecording:
    """Grids and markers in space of all frames."""

    def __init__(
        self,
        sensor: SensorDescription,
        grids: Mapping[str, Sequence[Grid]],
        limits: CheckParameters,
    ) -> None:
        self.sensor, self.grids, self.limits = sensor, grids, limits
        self.nominal = sensor.pattern.corners()
        wide = replace(sensor.triangulation, max_ray_gap=WIDEST_GAP_M)
        rig = StereoRig(replace(sensor, triangulation=wide))
        self.views: dict[str, ViewGeometry] = rig.views
        nothing = [None] * len(next(iter(grids.values())))
        pairs = zip(grids.get("left", nothing), grids.get("right", nothing), strict=True)
        markers = [rig.triangulate(left, right) for left, right in pairs]
        measured = np.stack([item.status == Status.MEASURED for item in markers])
        position = np.stack([item.position for item in markers])
        self.positions = np.where(measured[..., None], position, np.nan)
        self.gaps = np.where(measured, np.stack([item.ray_gap for item in markers]), np.nan)
        self.tracked = float(measured.mean())

    @property
    def two_views(self) -> bool:
        """Whether the views can be held against one another."""
        return len(self.views) == 2

    def pixels(self, view: str) -> NDArray[np.float64]:
        """Corners of all frames, (F, rows, cols, 2) px of the view."""
        return np.stack([grid.corners for grid in self.grids[view]])

    def rest(self) -> NDArray[np.intp]:
        """Frames of the gel at rest."""
        still = np.ones(len(self.positions), np.bool_)
        for name in self.views:
            still &= _still(self.pixels(name), self.limits.still)
        return rest_frames(self.positions, self.nominal, still, self.limits.rest_shape)

    def drift(self, rest: NDArray[np.intp]) -> RigidDrift | None:
        """Motion of the gel at rest against the description."""
        if not len(rest):
            return None
        known = np.isfinite(self.positions[rest][..., 0]).sum(axis=0)
        total = np.nansum(self.positions[rest], axis=0)
        mean = np.where((known > 0)[..., None], total / np.maximum(known, 1)[..., None], np.nan)
        if not self.two_views:
            mean[..., 2] = np.nan
        return rigid_drift(mean, self.nominal)

    def residuals(self, rest: NDArray[np.intp]) -> tuple[ViewResiduals, ...]:
        """Measured pixels minus the projection of the markers' points."""
        found = []
        for name, view in self.views.items():
            pixels = self.pixels(name)
            points = self.positions
            if not self.two_views:
                pixels = pixels[rest]
                points = np.broadcast_to(self.nominal, (*pixels.shape[:-1], 3))
            off = pixels - view.project(points)
            known = np.isfinite(off).all(axis=-1)
            numbers = rest if not self.two_views else np.arange(len(pixels))
            image = np.broadcast_to(numbers[:, None, None], known.shape)[known]
            used = np.ones(len(image), np.bool_)
            found.append(ViewResiduals(name, pixels[known], off[known], image, used))
        return tuple(found)

    def epipolar(self) -> NDArray[np.float64]:
        """Distance (K,) px of right pixels from the curves on which the left rays are seen."""
        known = np.isfinite(self.positions).all(axis=-1)
        points = self.positions[known]
        origins, directions = self.views["left"].rays(self.pixels("left")[known])
        along = ((points - origins) * directions).sum(axis=-1, keepdims=True)
        q, by_point = self.views["right"].project_with_jacobian(origins + along * directions)
        tangent = np.einsum("nij,nj->ni", by_point, directions)
        off = self.pixels("right")[known] - q
        across = off[:, 0] * tangent[:, 1] - off[:, 1] * tangent[:, 0]
        return np.asarray(np.abs(across) / np.linalg.norm(tangent, axis=-1))

    def rest_reprojection(self, rest: NDArray[np.intp]) -> float:
        """RMS distance, px, of the corners at rest from the projection of the nominal ones."""
        usable = np.isin(np.arange(len(self.positions)), rest)
        off = [
            observed(name, self.grids[name], usable).corners - view.project(self.nominal)
            for name, view in self.views.items()
        ]
        lengths2 = (np.stack(off) ** 2).sum(axis=-1)
        return float(np.sqrt(np.nanmean(lengths2)))


def _still(pixels: NDArray[np.float64], limit: float) -> NDArray[np.bool_]:
    """Which frames (F,) differ from a neighbour by no more than that in the median, px.

    A single frame has no neighbour: its shape alone tells then.
    """
    if len(pixels) < 2:
        return np.ones(len(pixels), np.bool_)
    lengths = np.linalg.norm(np.diff(pixels, axis=0), axis=-1).reshape(len(pixels) - 1, -1)
    steps = np.array(
        [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.inf for row in lengths]
    )
    # At rest for two frames at least: in between a gel passes its rest shape as well.
    quiet = steps <= limit
    return np.asarray(np.append(quiet, False) | np.insert(quiet, 0, False))
