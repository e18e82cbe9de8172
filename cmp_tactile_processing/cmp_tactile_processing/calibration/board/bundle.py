"""Joint fit of a rig's optical values and of the poses of a board in all images.

The poses have no priors and enter few residuals each.  They are eliminated: for each rig, every
board lies where it fits best, so that the fit of the rig has no more unknowns with more images
(variable projection, Golub and Pereyra 1973, with Kaufman's derivatives).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.calibration.map_fit import MapFit, map_fit, soft_loss
from cmp_tactile_processing.errors import CalibrationError, InputError
from cmp_tactile_processing.geometry.optics import ViewGeometry
from cmp_tactile_processing.geometry.rig_parameters import RigParameters

# Residuals lose weight beyond this many standard deviations, and are outliers beyond so many.
ROBUST, OUTLIER = 2.0, 6.0
# No residual below this is an outlier, px.
LEAST_OUTLIER_PX = 0.25
# Median length of a residual of standard deviation 1 per coordinate.
MEDIAN_LENGTH = np.sqrt(2 * np.log(2))
LEAST_NOISE_PX = 1e-6
FIT_ROUNDS = 4
# An image must keep so many corners, or it keeps none; then UNSEEN keeps its equations solvable.
FEWEST_CORNERS = 6
UNSEEN = 1e-6 * np.eye(6)
# A pose is found where a step is below this share of its standard deviation, or after so many.
POSE_TOLERANCE, POSE_STEPS, FIRST_DAMPING = 1e-4, 30, 1e-6
# The way over which a derivative by an optical value is taken, in deviations of its prior.
STEP = 1e-5
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
    residuals = boards.residuals(changes)
    if not np.isfinite(residuals).all():
        msg = "board: found the board behind a camera at the start of the fit, expected it in front"
        raise CalibrationError(msg)
    noise = _spread(residuals)
    for _ in range(2):
        fit = boards.fit(changes, noise, ROBUST)
        changes, residuals = fit.values, boards.residuals(fit.values)
        noise = _spread(residuals)
    for _ in range(FIT_ROUNDS):
        before = boards.used
        boards.use(residuals)
        noise = _deviation(residuals[boards.used], len(changes) + 6 * len(poses))
        fit = boards.fit(changes, noise, None)
        changes, residuals = fit.values, boards.residuals(fit.values)
        if np.array_equal(before, boards.used):
            break
    return Bundle(
        fit,
        boards.poses,
        [residuals[place] for place in boards.places()],
        [boards.used[place] for place in boards.places()],
        _deviation(residuals[boards.used], len(changes) + 6 * len(poses)),
    )


def _spread(residuals: Array) -> float:
    lengths = np.linalg.norm(residuals, axis=1)
    return max(float(np.median(lengths) / MEDIAN_LENGTH), LEAST_NOISE_PX)


def _deviation(residuals: Array, known: int) -> float:
    free = max(residuals.size - known, 1)
    return max(float(np.sqrt((residuals**2).sum() / free)), LEAST_NOISE_PX)


class _Boards:
    """Boards that lie where they fit best, as a function of the rig.

    used (N,): which of all corners count.
    """

    def __init__(
        self, rig: RigParameters, observations: Sequence[Observation], poses: Poses
    ) -> None:
        self._rig, self._images = rig, list(poses)
        # Those of an image beside one another, so that they can be summed up.
        number = {image: k for k, image in enumerate(self._images)}
        order = sorted(range(len(observations)), key=lambda k: number[observations[k].image])
        parts = [observations[k] for k in order]
        counts = [len(part.q) for part in parts]
        ends = np.cumsum([0, *counts])
        self._places = dict(zip(order, map(slice, ends[:-1], ends[1:]), strict=True))
        self._points = np.concatenate([part.points for part in parts])
        self._q = np.concatenate([part.q for part in parts])
        self._image = np.repeat([number[part.image] for part in parts], counts)
        self._first = np.searchsorted(self._image, np.arange(len(self._images)))
        views = np.repeat([part.view for part in parts], counts)
        self._of_view = {view: np.flatnonzero(views == view) for view in np.unique(views)}
        self._poses = np.stack([poses[image] for image in self._images])
        self.used = np.ones(len(self._q), np.bool_)

    @property
    def poses(self) -> dict[int, Array]:
        """T_gel_board by image."""
        return dict(zip(self._images, self._poses, strict=True))

    def places(self) -> list[slice]:
        """Where the corners of each observation are among all."""
        return [self._places[k] for k in range(len(self._places))]

    def use(self, residuals: Array) -> None:
        """Let all but outliers count, residuals (N, 2) px, and no image of which few are left."""
        lengths = np.linalg.norm(residuals, axis=1)
        limit = max(OUTLIER * float(np.nanmedian(lengths)) / MEDIAN_LENGTH, LEAST_OUTLIER_PX)
        used = lengths <= limit
        left = np.add.reduceat(used.astype(int), self._first)
        self.used = used & (left >= FEWEST_CORNERS)[self._image]

    def residuals(self, changes: Array, poses: Array | None = None) -> Array:
        """Measured minus modelled (N, 2) px, by default with the poses as they are; may be NaN."""
        return self._misfit(self._views(changes), self._poses if poses is None else poses)

    def fit(self, changes: Array, noise: float, robust: float | None) -> MapFit:
        """Fit the rig to the corners used, of that noise, and settle the boards with it."""
        search = _Search(self, noise, robust)
        fit = map_fit(
            search.residuals,
            self._rig.prior_std,
            start=changes,
            jacobian=search.jacobian,
            robust_scale=robust,
        )
        self.settle(fit.values, noise, robust)
        return fit

    def settle(self, changes: Array, noise: float, robust: float | None) -> None:
        """Move all boards to where they fit best, if they can be seen there."""
        poses = self.best_poses(changes, noise, robust)
        if poses is not None:
            self._poses = poses

    def best_poses(self, changes: Array, noise: float, robust: float | None) -> Array | None:
        """Poses (n, 4, 4) that fit best, looked for from those that there are; None if not seen.

        By the method of Levenberg and Marquardt, for each board by itself.
        """
        views, poses = self._views(changes), self._poses
        damping = np.full(len(poses), FIRST_DAMPING)
        costs = self._costs(self._misfit(views, poses) / noise, robust)
        if not np.isfinite(costs).all():
            return None
        for _ in range(POSE_STEPS):
            residuals, by_pose = self._linear(views, poses)
            weights = self._loss(residuals / noise, robust)[1] / noise**2
            H = self._summed(by_pose, weights, by_pose) + UNSEEN
            damped = H + damping[:, None, None] * H * np.eye(6)
            step = np.linalg.solve(damped, self._summed(by_pose, weights, residuals[..., None]))[
                ..., 0
            ]
            tried = _turned(poses, step)
            after = self._costs(self._misfit(views, tried) / noise, robust)
            better = after <= costs
            poses = np.where(better[:, None, None], tried, poses)
            costs, damping = np.where(better, after, costs), damping * np.where(better, 0.1, 10.0)
            # In standard deviations.
            if np.einsum("ni,nij,nj->n", step, H, step).max() < POSE_TOLERANCE**2:
                break
        return np.asarray(poses)

    def reduced_jacobian(self, changes: Array, noise: float, robust: float | None) -> Array:
        """Derivatives (N, 2, S) of the residuals, px, by the rig, while the boards follow it."""
        residuals, by_pose = self._linear(self._views(changes), self._poses)
        placed, columns = self._placed(self._poses), []
        for off in np.diag(STEP * self._rig.prior_std):
            moved = self._q - self._project(self._views(changes + off), placed)
            columns.append((moved - residuals) / off.sum())
        by_rig = np.where(self.used[:, None, None], np.stack(columns, axis=-1), 0.0)
        weights = self._loss(residuals / noise, robust)[1]
        H = self._summed(by_pose, weights, by_pose) + UNSEEN * noise**2
        follow = np.linalg.solve(H, self._summed(by_pose, weights, by_rig))
        return np.asarray(by_rig + by_pose @ -follow[self._image])

    def _loss(self, residuals: Array, robust: float | None) -> Array:
        """Loss and weight (2, N, 2) of whitened residuals, 0 for corners that do not count."""
        loss = soft_loss(residuals**2, robust)[:2]
        return np.where(self.used[:, None], loss, 0.0)

    def _costs(self, residuals: Array, robust: float | None) -> Array:
        """Of each image, (n,)."""
        return np.add.reduceat(self._loss(residuals, robust)[0].sum(axis=1), self._first)

    def _misfit(self, views: Mapping[str, ViewGeometry], poses: Array) -> Array:
        return self._q - self._project(views, self._placed(poses))

    def _views(self, changes: Array) -> dict[str, ViewGeometry]:
        return self._rig.views(changes)

    def _placed(self, poses: Array) -> Array:
        turned = np.einsum("nij,nj->ni", poses[self._image, :3, :3], self._points)
        return np.asarray(turned + poses[self._image, :3, 3])

    def _project(self, views: Mapping[str, ViewGeometry], placed: Array) -> Array:
        q = np.empty((len(placed), 2))
        for name, own in self._of_view.items():
            q[own] = views[name].project(placed[own])
        return q

    def _linear(self, views: Mapping[str, ViewGeometry], poses: Array) -> tuple[Array, Array]:
        """Residuals (N, 2) px, and what of them a turn and a shift of the board takes (N, 2, 6)."""
        placed = self._placed(poses)
        q, by_point = np.empty((len(placed), 2)), np.empty((len(placed), 2, 3))
        for name, own in self._of_view.items():
            q[own], by_point[own] = views[name].project_with_jacobian(placed[own])
        turned = placed - poses[self._image, :3, 3]
        # For a small turn w about the board's origin, w x p.
        by_turn = np.cross(turned[:, None, :], by_point)
        by_pose = np.concatenate([by_turn, by_point], axis=2)
        return np.nan_to_num(self._q - q), np.where(self.used[:, None, None], by_pose, 0.0)

    def _summed(self, a: Array, weights: Array, b: Array) -> Array:
        """Sums over each image's corners of a^T weights b: (N, 2, i), (N, 2), (N, 2, j)."""
        products = np.einsum("nki,nk,nkj->nij", a, weights, b)
        return np.asarray(np.add.reduceat(products, self._first))


@dataclass(frozen=True)
class _Search:
    """Whitened residuals of the corners that count, and their derivatives, for the fit of a rig."""

    boards: _Boards
    noise: float
    robust: float | None

    def residuals(self, changes: Array) -> Array:
        """(2 N,), 0 for those that do not count; NaN where a board cannot be placed."""
        used = self.boards.used[:, None]
        try:
            poses = self.boards.best_poses(changes, self.noise, self.robust)
        except InputError:
            poses = None
        if poses is None:
            return np.full(2 * len(used), np.nan)
        return np.where(used, self.boards.residuals(changes, poses), 0.0).ravel() / self.noise

    def jacobian(self, changes: Array) -> Array:
        """(2 N, S) of `residuals`; the next poses are looked for from those of here.

        It is asked for where a step was taken: a step that is refused moves no board.
        """
        self.boards.settle(changes, self.noise, self.robust)
        slope = self.boards.reduced_jacobian(changes, self.noise, self.robust)
        return np.asarray(slope.reshape(-1, len(changes)) / self.noise)


def _turned(poses: Array, step: NDArray[np.floating]) -> Array:
    """Poses (n, 4, 4) turned about their own origins by rotation vectors, then shifted; (n, 6)."""
    moved = poses.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ poses[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    return np.asarray(moved)
