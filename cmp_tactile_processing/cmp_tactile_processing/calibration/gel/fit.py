"""Fits the optical values of a sensor to where its own pattern is seen at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.gel.parameters import (
    GelCalibrationParameters,
    RigParameters,
)
from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit
from cmp_tactile_processing.calibration.observation import ViewObservation
from cmp_tactile_processing.calibration.outcome import ViewResiduals
from cmp_tactile_processing.errors import CalibrationError, DescriptionError, GeometryError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rigid_motion import local_mean
from cmp_tactile_processing.measured import Grid, Status
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.stereo.rig import StereoRig

__all__ = ["GelFit", "GelShape", "fit_gel", "gel_shape", "view_residuals"]

# Deviation of a print's corners from the regular pattern, px: the first guess leaves room for all
# that a wrong start may show, then the residuals show it.
FIRST_PRINT_PX, REFITS = 1.0, 2
# Median of the absolute values of Gaussian numbers to their standard deviation.
MEDIAN_TO_STD = 1.4826
# A corner this many standard deviations off is an outlier.
OUTLIER = 5.0
# A smooth error of the whole surface - its radius, the pitch - is a polynomial of this order;
# where that explains this share of the deviations, nothing local is the matter.
ORDER, EXPLAINED = 3, 0.9
# Averages over 3 x 3 corners scatter by this much less than single ones.
NEIGHBOURS_ROOT = 3.0
# No gap of the rays is too wide to look at: it is what is looked for.
WIDEST_GAP_M = 1e-2


@dataclass(frozen=True)
class GelFit:
    """The fitted sensor, its parameters and what the fit knows of them.

    print_px: standard deviation of the corners beyond what the images' noise explains.
    """

    sensor: SensorDescription
    parameters: RigParameters
    fit: MapFit
    print_px: float


def fit_gel(
    sensor: SensorDescription,
    seen: Sequence[ViewObservation],
    options: GelCalibrationParameters,
) -> GelFit:
    """The most probable optical values, given the mean corners and the description as prior.

    Raises CalibrationError where the description cannot be projected to begin with, and where the
    options hold every value.
    """
    parameters = RigParameters(sensor, options)
    if not parameters.free:
        msg = (
            f"{sensor.name}: found every optical value held, expected a deviation above 0 for some"
        )
        raise CalibrationError(msg)
    fit, print_px = _fit(parameters, seen, FIRST_PRINT_PX, None)
    for _ in range(REFITS):
        fit, print_px = _fit(parameters, seen, print_px, fit.values)
    return GelFit(parameters.sensor(fit.values), parameters, fit, print_px)


def _fit(
    parameters: RigParameters,
    seen: Sequence[ViewObservation],
    print_px: float,
    start: NDArray[np.float64] | None,
) -> tuple[MapFit, float]:
    """The fit that takes the print for as good as that, and how good it turns out to be."""
    spread = np.concatenate([np.hypot(view.std[view.seen], print_px) for view in seen])
    fit = map_fit(
        _Residuals(parameters, seen, spread),
        parameters.prior_std,
        start=start,
        robust_scale=parameters.options.robust_scale,
    )
    return fit, _beyond_noise(fit.residuals.reshape(-1, 2) * spread[:, None], seen)


def view_residuals(
    sensor: SensorDescription, seen: Sequence[ViewObservation], print_px: float
) -> tuple[ViewResiduals, ...]:
    """Measured minus modelled mean corners of each view; outliers are marked as not used."""
    views, pattern = build_views(sensor), sensor.pattern.corners()
    found = []
    for view in seen:
        pixels = view.corners[view.seen]
        residuals = pixels - views[view.view].project(pattern[view.seen])
        spread = np.hypot(view.std[view.seen], print_px)
        used = np.linalg.norm(residuals, axis=-1) <= OUTLIER * np.sqrt(2) * spread
        image = np.zeros(len(pixels), np.intp)
        found.append(ViewResiduals(view.view, pixels, residuals, image, used))
    return tuple(found)


class _Residuals:
    """Whitened residuals of all corners that were seen; NaN where a rig cannot show them."""

    def __init__(
        self,
        parameters: RigParameters,
        seen: Sequence[ViewObservation],
        spread: NDArray[np.float64],
    ) -> None:
        self._parameters, self._spread = parameters, spread[:, None]
        self._pixels = np.concatenate([view.corners[view.seen] for view in seen])
        corners = parameters.sensor(np.zeros(len(parameters.free))).pattern.corners()
        self._points = {view.view: corners[view.seen] for view in seen}

    def __call__(self, changes: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            views = build_views(self._parameters.sensor(changes))
        except (DescriptionError, GeometryError):
            return np.full(self._pixels.size, np.nan)
        shown = [views[name].project(points) for name, points in self._points.items()]
        return np.asarray(((self._pixels - np.concatenate(shown)) / self._spread).ravel())


def _beyond_noise(residuals: NDArray[np.float64], seen: Sequence[ViewObservation]) -> float:
    """What the residuals (N, 2) px show beyond the noise of the mean corners, px."""
    spread = MEDIAN_TO_STD * float(np.median(np.abs(residuals)))
    noise = float(np.median(np.concatenate([view.std[view.seen] for view in seen])))
    return float(np.sqrt(max(0.0, spread**2 - noise**2)))


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
    known = off[..., : 2 if len(seen) < 2 else 3]
    smooth = local_mean(known)
    rough = np.linalg.norm(known - smooth, axis=-1)
    rough = rough[np.isfinite(rough)]
    noise = float(np.median(rough)) / NEIGHBOURS_ROOT if rough.size else 0.0
    deviation = np.concatenate([smooth, off[..., known.shape[-1] :]], axis=-1)
    return GelShape(markers.position, deviation, noise, markers.ray_gap)


def _grid(sensor: SensorDescription, view: ViewObservation) -> Grid:
    empty = Grid.missing(sensor.pattern.shape, "")
    status = np.where(view.seen, Status.MEASURED, Status.MISSING).astype(np.uint8)
    return replace(empty, corners=view.corners, corner_status=status, corner_std=view.std)
