"""The gel at rest as a gauge: what its markers, whose places are described, show of the sensor.

Where the views see the corners at rest follows from the description.  They see them elsewhere by
what is wrong with it: lens, mirrors, poses, layers, the print, the shape of the surface.  These are
fitted to the mean corners of a reference, each within the deviation that it may have.  From the fit
follow the errors of displacements that are the same in all frames: their expected size, and what
stays open.  It is a self-calibration with priors (Triggs et al., Bundle Adjustment, 2000, 9.3),
linear in the changes, with repeated steps for what is not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.cache.threads import one_thread
from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.geometry.rigid_motion import NEIGHBOURS, largest_local_mean
from cmp_tactile_processing.measured import MAD_TO_STD, Systematics
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.surface.description_changes import DescriptionChanges

Array: TypeAlias = NDArray[np.float64]

# No print is known to be nearer to its places, px.
MIN_PRINT_PX = 5e-3
# From so many deviations on, a corner counts less.
ROBUST_SCALE = 3.0
MAX_STEPS = 12
# A step that makes the fit worse is halved at most so often.
MAX_HALVINGS = 4
# The derivatives are computed again if the pixels differ by more than this from their prediction.
MAX_LINEAR_ERROR_PX = 0.05
# The fit has converged where a step is shorter, in deviations of the prior.
CONVERGED = 1e-3
# Share of the corners without which nothing is fitted.
MIN_SEEN_SHARE = 0.5
# The description is doubtful where displacements are off by more than this share, and by so many
# times what the fit leaves open.
DOUBTFUL_SHARE, DOUBTFUL_DEVIATIONS = 0.02, 2.0
# A smaller misfit needs no explanation.
MIN_EXPLAINED_PX = 0.1
# A single change explains a misfit if it leaves at most this many times what the best one leaves,
# or this share of the misfit.
MAX_BEST_RATIO = 2.0
MAX_UNEXPLAINED_SHARE = 0.1
MAX_NAMED = 3


@dataclass(frozen=True)
class GaugeReading:
    """What a reference shows of the description.

    misfit_px: RMS distance of the corners from where the description has them; left_px: of what no
    change of it explains; bump: the largest such distance of neighbouring corners, m on the gel.
    explanation: the single changes of the description that explain most, empty where none does.
    """

    systematics: Systematics
    misfit_px: float
    left_px: float
    bump: float
    explanation: str

    @property
    def share(self) -> float:
        """By how much displacements and forces are off; 0 where that is not certain."""
        parts = self.systematics.bias, self.systematics.spread
        bias, spread = (np.sqrt(np.diag(part)) for part in parts)
        certain = bias > np.maximum(DOUBTFUL_SHARE, DOUBTFUL_DEVIATIONS * spread)
        return float(bias[certain].max()) if certain.any() else 0.0

    @property
    def doubt(self) -> str:
        """What is wrong with the description and what to do; empty where nothing is certain."""
        if not self.share:
            return ""
        cause = f", as if {self.explanation}" if self.explanation else ""
        return (
            f"the gel at rest is not where the description has it ({self.misfit_px:.1f} px off): "
            f"displacements and forces are off by about {self.share:.0%}{cause}; measure the print "
            "and the rig, or run `cmp_tactile calibrate gel`"
        )


class _Fit(NamedTuple):
    """changes (n,), covariance (n, n); left (views, N, 2) px, NaN where not seen."""

    changes: Array
    covariance: Array
    left: Array


class RestGauge:
    """Reads references of one sensor.  Raises InputError as `build_views` does."""

    def __init__(self, sensor: SensorDescription) -> None:
        self._shape = sensor.pattern.rows, sensor.pattern.cols
        self._possible = DescriptionChanges(sensor)

    def prepare(self) -> None:
        """Make what the first reading needs, half a second on one core; any thread may."""
        described = self._possible.pixels(0 * self._possible.prior_std)
        self.read(dict(zip(self._possible.views, described, strict=True)))

    def read(self, corners: Mapping[str, Array]) -> GaugeReading | None:
        """What the mean corners (rows, cols, 2) px at rest show, by view.

        None where fewer than half of them are seen in all views, or where no rig explains them.
        """
        possible = self._possible
        measured = np.stack([corners[name].reshape(-1, 2) for name in possible.views])
        if np.isfinite(measured).all(axis=(0, -1)).mean() < MIN_SEEN_SHARE:
            return None
        with one_thread():
            fit = self._fit(measured)
            if fit is None:
                return None
            effects, by_change = possible.effects(fit.changes), possible.effects_by_change
            spread = by_change @ fit.covariance @ by_change.swapaxes(1, 2)
            return GaugeReading(
                Systematics(effects.T @ effects / len(effects), spread.mean(axis=0)),
                _rms(measured - possible.pixels(0 * fit.changes)),
                _rms(fit.left),
                largest_local_mean(possible.on_gel(fit.left).reshape(*self._shape, 3)),
                self._explanation(fit.changes),
            )

    def _fit(self, measured: Array) -> _Fit | None:
        """The most probable changes for pixels (views, N, 2); None where no rig has them.

        Gauss and Newton's steps, with a robust loss; how far the print is off follows from what is
        left.
        """
        possible, prior = self._possible, self._possible.prior_std
        compared = measured[:, possible.compared]
        seen = np.isfinite(compared).all(axis=-1)
        known = np.asarray(np.linalg.inv(possible.prior / np.outer(prior, prior)), np.float64)

        def left_by(changes: Array) -> Array:
            return (compared - possible.pixels(changes * prior)[:, possible.compared])[seen].ravel()

        changes, jacobian = np.zeros_like(prior), possible.jacobian
        try:
            left = left_by(changes)
            for _ in range(MAX_STEPS):
                by_change = jacobian[seen].reshape(-1, len(prior)) * prior
                std = max(MIN_PRINT_PX, MAD_TO_STD * float(np.median(np.abs(left))))
                weight = 1 / np.sqrt(1 + (left / (ROBUST_SCALE * std)) ** 2) / std**2
                normal = by_change.T @ (weight[:, None] * by_change) + known
                step = np.linalg.solve(normal, by_change.T @ (weight * left) - known @ changes)
                loss = _loss(left / std, changes, known)
                for _ in range(MAX_HALVINGS):
                    after = left_by(changes + step)
                    if _loss(after / std, changes + step, known) < loss:
                        break
                    step = step / 2
                if float(np.abs(step).max()) < CONVERGED:
                    break
                changes, curved = changes + step, after - (left - by_change @ step)
                left = after
                if float(np.sqrt(np.mean(curved**2))) > MAX_LINEAR_ERROR_PX:
                    jacobian = possible.jacobian_at(changes * prior)
            off = measured - possible.pixels(changes * prior)
        except InputError:
            return None
        # Where not all corners are compared, fewer of them are alike.
        # What is left of neighbouring corners is alike: they count as one.
        alike = max(1.0, NEIGHBOURS * len(possible.compared) / measured.shape[1])
        information = by_change.T @ by_change / (std**2 * alike) + known
        covariance = np.linalg.inv(information) * np.outer(prior, prior)
        return _Fit(changes * prior, covariance, off)

    def _explanation(self, changes: Array) -> str:
        """The single changes that explain best what all of them together explain."""
        possible, prior = self._possible, self._possible.prior_std
        slopes = possible.jacobian.reshape(-1, len(changes)) * prior
        explained = slopes @ (changes / prior)
        pose = possible.pose
        misfit, _ = _left_of(slopes[:, pose], explained)
        if misfit < MIN_EXPLAINED_PX:
            return ""
        tried = []
        for change in possible.checkable():
            left, values = _left_of(slopes[:, [*pose, *change.columns]], explained)
            value = float(values[len(pose)] * prior[change.columns[0]])
            tried.append((left, f"{change.name} {change.format.format(value)}"))
        tried.sort()
        most = max(MAX_BEST_RATIO * tried[0][0], MAX_UNEXPLAINED_SHARE * misfit)
        named = [text for left, text in tried if left <= min(most, misfit / 2)]
        return " or ".join(named[:MAX_NAMED])


def _loss(left: Array, changes: Array, known: Array) -> float:
    """Of what is left (m,), in its deviations, and of changes (n,) whose inverse covariance is."""
    robust = 2 * ROBUST_SCALE**2 * (np.sqrt(1 + (left / ROBUST_SCALE) ** 2) - 1)
    return float(robust.sum() + changes @ known @ changes)


def _left_of(slopes: Array, data: Array) -> tuple[float, Array]:
    """RMS that a fit of parameters leaves of data (m,), and the fitted values (n,)."""
    values = np.asarray(np.linalg.lstsq(slopes, data, rcond=None)[0])
    return float(np.sqrt(np.mean((data - slopes @ values) ** 2))), values


def _rms(off: Array) -> float:
    """RMS length of (..., 2), NaN left out."""
    squares = (off**2).sum(axis=-1)
    return float(np.sqrt(squares[np.isfinite(squares)].mean()))
