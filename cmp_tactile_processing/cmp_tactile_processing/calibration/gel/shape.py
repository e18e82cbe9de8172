"""The marker surface as a calibrated sensor sees it, against its known shape at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.observation import ViewObservation
from cmp_tactile_processing.geometry.rigid_motion import local_mean
from cmp_tactile_processing.measured.grid import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig

__all__ = ["GelShape", "gel_shape"]

# A smooth error of the whole surface - its radius, the pitch - is a polynomial of this order;
# where that explains this share of the deviations, nothing local is the matter.
ORDER, EXPLAINED = 3, 0.9
# Averages over 3 x 3 corners scatter by this much less than single ones.
NEIGHBOURS_ROOT = 3.0
# No gap of the rays is too wide to look at: it is what is looked for.
WIDEST_GAP_M = 1e-2


@dataclass(frozen=True)
class GelShape:
    """Deviation of the surface from its shape at rest.

    position (rows, cols, 3) m, deviation (rows, cols, 3) m from the nominal one, averaged over 3 x
    3 corners, z NaN for one view; noise: standard deviation of those averages from the flaws of
    the print and the images' noise, m.  ray_gap (rows, cols) m, NaN for one view.
    """

    position: NDArray[np.float64]
    deviation: NDArray[np.float64]
    noise: float
    ray_gap: NDArray[np.float64]

    @property
    def known(self) -> bool:
        """Whether anything was seen of it."""
        return bool(np.isfinite(self._lengths).any())

    @property
    def peak(self) -> float:
        """The largest deviation, m."""
        return float(np.nanmax(self._lengths)) if self.known else 0.0

    @property
    def peak_corner(self) -> tuple[int, int]:
        """Where it is: row and column."""
        flat = int(np.nanargmax(self._lengths)) if self.known else 0
        row, col = np.unravel_index(flat, self._lengths.shape)
        return int(row), int(col)

    @property
    def rms_gap(self) -> float:
        """Root mean square of the rays' gap, m; NaN for one view."""
        gaps = self.ray_gap[np.isfinite(self.ray_gap)]
        return float(np.sqrt((gaps**2).mean())) if gaps.size else float("nan")

    @property
    def smooth_share(self) -> float:
        """Share of the squared deviations that a smooth error of the whole surface explains."""
        rows, cols = self._lengths.shape
        y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
        known = np.isfinite(self._lengths)
        deviation = np.nan_to_num(self.deviation[known])
        powers = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
        basis = np.stack([x[known] ** i * y[known] ** j for i, j in powers], axis=1)
        left = deviation - basis @ np.linalg.lstsq(basis, deviation, rcond=None)[0]
        return float(1 - (left**2).sum() / max(float((deviation**2).sum()), 1e-30))

    @property
    def local(self) -> bool:
        """Whether the deviations are those of a contact, not of a wrong shape as a whole."""
        return self.smooth_share < EXPLAINED

    @property
    def _lengths(self) -> NDArray[np.float64]:
        known = np.isfinite(self.deviation[..., :2]).all(axis=-1)
        lengths = np.linalg.norm(np.nan_to_num(self.deviation), axis=-1)
        return np.where(known, lengths, np.nan)


def gel_shape(sensor: SensorDescription, seen: Sequence[ViewObservation]) -> GelShape:
    """The surface that the mean corners show."""
    wide = replace(sensor.triangulation, max_ray_gap=WIDEST_GAP_M)
    rig = StereoRig(replace(sensor, triangulation=wide))
    grids = {view.view: _grid(sensor, view) for view in seen}
    markers = rig.triangulate(grids.get("left"), grids.get("right"))
    off = markers.position - sensor.pattern.corners()
    told = off[..., : 2 if len(seen) < 2 else 3]
    smooth = local_mean(told)
    rough = np.linalg.norm(told - smooth, axis=-1)
    rough = rough[np.isfinite(rough)]
    noise = float(np.median(rough)) / NEIGHBOURS_ROOT if rough.size else 0.0
    deviation = np.concatenate([smooth, off[..., told.shape[-1] :]], axis=-1)
    return GelShape(markers.position, deviation, noise, markers.ray_gap)


def _grid(sensor: SensorDescription, view: ViewObservation) -> Grid:
    empty = Grid.missing(sensor.pattern.shape, "")
    status = np.where(view.seen, Status.MEASURED, Status.MISSING).astype(np.uint8)
    return replace(empty, corners=view.corners, corner_status=status, corner_std=view.std)
