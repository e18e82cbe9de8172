"""Sub-pixel position of checker corners: a saddle point, refined by a model of the corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmp_tactile_processing.image.prepared import PreparedImage
from cmp_tactile_processing.tracking.corners.model import CornerPrior, refine_by_model, work_space
from cmp_tactile_processing.tracking.corners.quadratic_saddle import (
    find_saddles,
    gradient_gain,
    quadratic_work,
)

__all__ = ["SaddlePointFit", "SaddlePoints"]

# Half the width of the window, in checker sides and at least.  Its weights fall to zero there.
WINDOW_PER_SIDE, LEAST_WINDOW_PX, MOST_WINDOW_PX = 0.3, 2.2, 6.0
# The same of the window that looks for corners which the start is far from.
WIDE_PER_SIDE, MOST_WIDE_PX = 0.7, 30.0
# The window has arrived when it would move by less than this, px; by less than ROUGHLY_PX where the
# corner model takes over.
CONVERGED_PX, ROUGHLY_PX = 0.02, 0.1
# Error of the saddle point and of the model without noise, px per coordinate.
BIAS_PX, MODEL_BIAS_PX = 0.006, 0.003
# Corners of checkers of at least this side are refined by the corner model.
LEAST_SIDE_OF_MODEL_PX = 8.0
MODEL_PER_SIDE, MOST_MODEL_PX = 0.42, 10.0
# Typical turn of a gridline and change of the light, in half contrasts, from checker to checker.
TURN_PER_CHECKER, LIGHT_PER_CHECKER = 0.02, 0.05
# Half contrasts by which the model may differ from a clean image, and beyond how many times this
# and the noise together a pixel counts as an outlier.
MISFIT, OUTLIER = 0.015, 2.5
# Blur that the model starts with at an image's first corner, px.
FIRST_BLUR_PX = 1.0
# Where the model's corner lies farther from the saddle point, in px and in standard deviations of
# the saddle point, the print is flawed there.
APART_PX, APART_STD = 0.1, 4.0
NONE_UNKNOWN = np.zeros((0, 0), np.bool_)


@dataclass(frozen=True)
class SaddlePoints:
    """position (n, 2) px, NaN where the fit failed; hessian (n, 3): xx, xy, yy, grey / px^2;
    std (n,): standard deviation of the position, px per coordinate.
    """

    position: NDArray[np.float64]
    hessian: NDArray[np.float64]
    std: NDArray[np.float64]


class SaddlePointFit:
    """Finds corners near given starts.

    side_px: side of a checker, which limits the windows to the surroundings of one corner.
    Keeps buffers: one thread at a time.
    """

    def __init__(self, side_px: float) -> None:
        self._window = float(np.clip(WINDOW_PER_SIDE * side_px, LEAST_WINDOW_PX, MOST_WINDOW_PX))
        self._wide = max(min(WIDE_PER_SIDE * side_px, MOST_WIDE_PX), self._window)
        self._quadratic = quadratic_work(self._wide)
        self._by_model = side_px >= LEAST_SIDE_OF_MODEL_PX
        self._prior = CornerPrior(
            radius=min(MODEL_PER_SIDE * side_px, MOST_MODEL_PX),
            noise=0.0,
            bend=TURN_PER_CHECKER / side_px,
            light=LIGHT_PER_CHECKER / side_px,
            misfit=MISFIT,
            outlier=OUTLIER,
            bias=MODEL_BIAS_PX,
        )
        self._work = work_space(self._prior.radius)

    def fit(
        self, image: PreparedImage, start: NDArray[np.float64], reach_px: ArrayLike
    ) -> SaddlePoints:
        """Corners near `start` (n, 2) px; reach_px () or (n,): how far each may lie from its start.

        First the saddle point of the smoothed image: a quadratic is fitted by weighted least
        squares in a window, which moves to the quadratic's stationary point until it stands still.
        The weights move by fractions of a pixel and fall to zero at the window's border: a window
        that stayed on whole pixels would bias the point towards them.  Then, but for the smallest
        checkers, the model of two blurred edges is fitted to the image that is not smoothed.

        Rows are NaN where there is no saddle, where the search leaves the image, goes farther than
        `reach_px` from the start or does not converge.
        """
        n = len(start)
        # Copies: a read-only or strided array would have the kernels compiled anew for its type.
        first, reach = np.array(start, dtype=np.float64, order="C"), np.empty(n)
        reach[:] = reach_px
        saddles = np.empty((n, 2)), np.empty((n, 3)), np.empty(n)
        arrived = ROUGHLY_PX if self._by_model else CONVERGED_PX
        error = image.noise * gradient_gain(self._window, image.smoothing_px)
        limits = (self._wide, self._window, arrived, error)
        find_saddles(image.smooth, (first, reach), limits, saddles, self._quadratic)
        saddles[2][:] = np.hypot(saddles[2], BIAS_PX)
        if self._by_model:
            self._prior = self._prior._replace(noise=image.noise)
            unknown = NONE_UNKNOWN if image.replaced is None else image.replaced
            pixels = np.ascontiguousarray(image.grey), unknown
            modelled = saddles[0].copy(), saddles[1], saddles[2].copy()
            refine_by_model(pixels, self._prior, modelled, FIRST_BLUR_PX, self._work)
            # Salt and pepper, of which the model knows, is no flaw of the print.
            if image.replaced is not None:
                return SaddlePoints(*modelled)
            _take_where_alike(modelled, saddles)
        return SaddlePoints(*saddles)


def _take_where_alike(
    modelled: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    saddles: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Replace saddle points by the model's corners where noise alone sets the two apart.

    Ink that is not as the model has it may make it leave out other pixels in the next frame; the
    saddle point is then off by more, but by the same.
    """
    apart = np.hypot(*(modelled[0] - saddles[0]).T)
    alike = ~(apart > np.maximum(APART_PX, APART_STD * saddles[2]))
    saddles[0][alike], saddles[2][alike] = modelled[0][alike], modelled[2][alike]
    # What the flaw may pull it by.
    saddles[2][~alike] = np.hypot(saddles[2][~alike], apart[~alike])
