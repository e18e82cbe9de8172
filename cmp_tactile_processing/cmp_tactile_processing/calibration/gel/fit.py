"""Fits the optical values of a sensor to where its own pattern is seen at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.gel.rig_parameters import (
    GelCalibrationParameters,
    RigParameters,
)
from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit
from cmp_tactile_processing.calibration.observation import ViewObservation
from cmp_tactile_processing.calibration.outcome import ViewResiduals
from cmp_tactile_processing.errors import CalibrationError, DescriptionError, GeometryError
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.sensor.description import SensorDescription

__all__ = ["GelFit", "fit_gel", "reprojection", "view_residuals"]

# Deviation of a print's corners from the regular pattern, px: the first guess leaves room for all
# that a wrong start may show, then the residuals tell it.
FIRST_PRINT_PX, REFITS = 1.0, 2
# Median of the absolute values of Gaussian numbers to their standard deviation.
MEDIAN_TO_STD = 1.4826
# A corner this many standard deviations off is an outlier.
OUTLIER = 5.0


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


def reprojection(residuals: Sequence[ViewResiduals], *, all_corners: bool = False) -> float:
    """Root mean square length of the residuals of all views, px; NaN without any."""
    parts = [item.residuals if all_corners else item.residuals[item.used] for item in residuals]
    lengths2 = (np.concatenate(parts) ** 2).sum(axis=-1)
    return float(np.sqrt(lengths2.mean())) if lengths2.size else float("nan")


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
