"""Joint fit of a rig's optical values and of the poses of a board in all images.

Bundle adjustment (Triggs et al. 2000): a corner depends on the rig and on the pose of the board in
its own image alone, so the Jacobian is sparse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import OptimizeResult, least_squares
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.map_fit import LEAST_GAIN, MOST_STEPS, MapFit, soft_loss
from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.geometry.rig_parameters import RigParameters

# Residuals lose weight beyond this many standard deviations, and are outliers beyond so many.
ROBUST, OUTLIER = 2.0, 6.0
# No residual below this is an outlier, px.
LEAST_OUTLIER_PX = 0.25
# Median length of a residual of standard deviation 1 per coordinate.
MEDIAN_LENGTH = np.sqrt(2 * np.log(2))
LEAST_NOISE_PX = 1e-6
FIT_ROUNDS = 4
# An image must keep so many corners, or it keeps none.
FEWEST_CORNERS = 6
# Keeps the equations of a board solvable of which no corner is used.
UNSEEN = 1e-6
# Each step is solved to this precision, relative: the conjugate gradients then need no more steps
# than an exact solution.
SOLVED = 1e-10
Array = NDArray[np.float64]
Poses = Mapping[int, Array]


@dataclass(frozen=True)
class Observation:
    """Corners of one image of a view: points (n, 3) m, board frame, seen at q (n, 2) px."""

    view: str
    image: int
    points: Array
    q: Array


@dataclass(frozen=True)
class Bundle:
    """The fit.

    fit: of the rig's free values; poses: T_gel_board of each image, (4, 4).
    residuals: (n, 2) px of each observation, measured minus modelled, NaN behind the camera; used:
    (n,) of each.  noise: standard deviation of a residual's coordinate, px.
    """

    fit: MapFit
    poses: dict[int, Array]
    residuals: list[Array]
    used: list[NDArray[np.bool_]]
    noise: float


def adjust(
    rig: RigParameters, observations: Sequence[Observation], start: tuple[Array, Poses]
) -> Bundle:
    """The most probable rig and poses, from a start: changes of the rig, T_gel_board by image.

    First with a soft loss, then plain least squares of all but outliers.  Raises CalibrationError
    where the start puts no board in front of a camera.
    """
    changes, poses = start
    boards = _Boards(rig, observations, poses)
    x = np.concatenate([changes / rig.prior_std, np.zeros(6 * len(poses))])
    residuals = boards.residuals(x)
    if not np.isfinite(residuals).all():
        msg = "board: found the board behind a camera at the start of the fit, expected it in front"
        raise CalibrationError(msg)
    for _ in range(2):
        x = boards.fit(x, _spread(residuals), ROBUST).x
        residuals = boards.residuals(x)
    for _ in range(FIT_ROUNDS):
        before = boards.used
        boards.use(residuals)
        noise = _deviation(residuals[boards.used], len(x))
        found = boards.fit(x, noise, None)
        x, residuals = found.x, boards.residuals(found.x)
        if np.array_equal(before, boards.used):
            break
    ends = np.cumsum([len(item.q) for item in observations])[:-1]
    return Bundle(
        boards.map_fit(found),
        boards.poses(x),
        np.split(residuals, ends),
        np.split(boards.used, ends),
        _deviation(residuals[boards.used], len(x)),
    )


def _spread(residuals: Array) -> float:
    lengths = np.linalg.norm(residuals, axis=1)
    return max(float(np.median(lengths) / MEDIAN_LENGTH), LEAST_NOISE_PX)


def _deviation(residuals: Array, known: int) -> float:
    free = max(residuals.size - known, 1)
    return max(float(np.sqrt((residuals**2).sum() / free)), LEAST_NOISE_PX)


class _Boards:
    """Corners of all boards as a function of x: changes of the rig in deviations of their priors,
    then turn (rad) and shift (m) of each board from its start.

    used (N,): which of all corners count.
    """

    def __init__(
        self, rig: RigParameters, observations: Sequence[Observation], poses: Poses
    ) -> None:
        self._rig, self._images = rig, list(poses)
        number = {image: k for k, image in enumerate(self._images)}
        counts = [len(item.q) for item in observations]
        self._points = np.concatenate([item.points for item in observations])
        self._q = np.concatenate([item.q for item in observations])
        self._image = np.repeat([number[item.image] for item in observations], counts)
        views = np.repeat([item.view for item in observations], counts)
        self._of_view = {view: np.flatnonzero(views == view) for view in np.unique(views)}
        self._start = np.stack([poses[image] for image in self._images])
        self.used = np.ones(len(self._q), np.bool_)

    def poses(self, x: Array) -> dict[int, Array]:
        """T_gel_board by image."""
        return dict(zip(self._images, self._moved(x), strict=True))

    def use(self, residuals: Array) -> None:
        """Let all but outliers count, residuals (N, 2) px, and no image of which few are left."""
        lengths = np.linalg.norm(residuals, axis=1)
        limit = max(OUTLIER * float(np.nanmedian(lengths)) / MEDIAN_LENGTH, LEAST_OUTLIER_PX)
        used = lengths <= limit
        left = np.bincount(self._image, used)
        self.used = used & (left >= FEWEST_CORNERS)[self._image]

    def residuals(self, x: Array) -> Array:
        """Measured minus modelled (N, 2) px; NaN where a board cannot be seen."""
        try:
            views = self._rig.views(x[: len(self._rig.free)] * self._rig.prior_std)
        except InputError:
            return np.full(self._q.shape, np.nan)
        poses = self._moved(x)[self._image]
        placed = np.einsum("nij,nj->ni", poses[:, :3, :3], self._points) + poses[:, :3, 3]
        q = np.empty((len(placed), 2))
        for name, own in self._of_view.items():
            q[own] = views[name].project(placed[own])
        return self._q - q

    def fit(self, x: Array, noise: float, robust: float | None) -> OptimizeResult:
        """Fit rig and boards to the corners used, of that noise."""
        count, used = len(self._rig.free), self.used[:, None]

        def whitened(x: Array) -> Array:
            data = np.where(used, self.residuals(x), 0.0).ravel() / noise
            return np.concatenate([data, x[:count]])

        def loss(z: Array) -> Array:
            rho = soft_loss(z, None)
            rho[:, :-count] = soft_loss(z[:-count], robust)
            return rho

        return least_squares(
            whitened,
            x,
            jac_sparsity=self._sparsity(),
            loss=loss,
            x_scale="jac",
            ftol=LEAST_GAIN,
            xtol=1e-12,
            gtol=None,
            max_nfev=MOST_STEPS,
            tr_options={"atol": SOLVED, "btol": SOLVED, "maxiter": 20 * len(x)},
        )

    def map_fit(self, found: OptimizeResult) -> MapFit:
        """The rig's part of a plain fit, with the boards free to follow it."""
        count, scale = len(self._rig.free), self._rig.prior_std
        H = (found.jac.T @ found.jac).tocsc()
        of_boards = H[count:, count:] + UNSEEN * sparse.identity(H.shape[0] - count, format="csc")
        coupled = H[count:, :count]
        follow = spsolve(of_boards, coupled)
        information = (H[:count, :count] - coupled.T @ follow).toarray()
        covariance = np.linalg.inv(information) * np.outer(scale, scale)
        data = found.fun[:-count]
        weights = np.ones_like(data)
        values = found.x[:count] * scale
        return MapFit(values, covariance, scale, data, weights, bool(found.status > 0))

    def _moved(self, x: Array) -> Array:
        """Poses (n, 4, 4), turned about their own origins, then shifted."""
        steps = x[len(self._rig.free) :].reshape(-1, 6)
        moved = self._start.copy()
        moved[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ moved[:, :3, :3]
        moved[:, :3, 3] += steps[:, 3:]
        return np.asarray(moved)

    def _sparsity(self) -> sparse.csr_matrix:
        """Which residuals and priors depend on which of x."""
        count = len(self._rig.free)
        boards = np.repeat(np.eye(len(self._images), dtype=np.int8)[self._image], 2, axis=0)
        data = sparse.hstack(
            [np.ones((2 * len(self._q), count), np.int8), sparse.kron(boards, np.ones((1, 6)))]
        )
        priors = sparse.eye(count, data.shape[1])
        return sparse.vstack([data, priors]).tocsr()
