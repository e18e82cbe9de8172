"""Joint fit of a rig's parameters and of the poses of a board in all images.

The poses have no priors and enter few residuals each: they are eliminated (Schur complement), so
that a step costs the same for each image however many there are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.errors import CalibrationError
from cmp_tactile_processing.geometry.lens import Lens
from cmp_tactile_processing.geometry.optics import FLIP_X, reflection, tilt_axes, tilt_directions
from cmp_tactile_processing.sensor.parts import Camera, Mirror

COEFFICIENTS = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "equidistant": ("k1", "k2", "k3", "k4")}
NONE = np.zeros(3)
# Residuals lose weight beyond this many standard deviations, and are outliers beyond so many.
HUBER, OUTLIER = 2.0, 6.0
# No residual below this is an outlier, px.
LEAST_OUTLIER_PX = 0.25
# Median length of a residual of standard deviation 1 per coordinate.
MEDIAN_LENGTH = np.sqrt(2 * np.log(2))
LEAST_NOISE_PX = 1e-6
MOST_STEPS, CONVERGED = 40, 1e-8
FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e10
ROUNDS = 4
# An image must keep so many corners, or it keeps none; then UNSEEN keeps its equations solvable.
FEWEST_CORNERS = 6
UNSEEN = 1e-6 * np.eye(6)


@dataclass(frozen=True)
class Projection:
    """q (n, 2) px; by_shared (n, 2, S) by the rig's parameters; by_point (n, 2, 3) by the point."""

    q: NDArray[np.float64]
    by_shared: NDArray[np.float64]
    by_point: NDArray[np.float64]


NOTHING = Projection(np.empty((0, 2)), np.empty((0, 2, 0)), np.empty((0, 2, 3)))


class RigModel(Protocol):
    """A rig with a vector of parameters (S,) that all images share."""

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is."""

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """Pixels of points (n, 3) m, reference frame, in a view; NaN behind its camera."""

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """(4, 4): reference frame -> right-handed optical frame of a view."""

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Unit viewing directions (n, 3), that optical frame, of pixels (n, 2)."""


def camera_vector(camera: Camera) -> NDArray[np.float64]:
    """fx, fy, cx, cy and the distortion."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def camera_of(model: str, values: NDArray[np.float64]) -> Camera:
    """The camera of such a vector."""
    fx, fy, cx, cy, *distortion = (float(value) for value in values)
    return Camera(model, fx, fy, cx, cy, tuple(distortion))


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the entries of camera_vector."""
    distortion = (f"distortion[{k}]" for k in range(len(COEFFICIENTS[model])))
    return ("fx", "fy", "cx", "cy", *distortion)


@dataclass(frozen=True)
class CameraPair:
    """One or two plain cameras; the reference frame is the left one's optical frame.

    Parameters: those of each camera, then rotation vector and translation, m, of T_right_left.
    """

    model: str
    views: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is."""
        names = [f"{view}.{name}" for view in self.views for name in parameter_names(self.model)]
        if len(self.views) == 2:
            names += [f"right: turn about {axis}" for axis in "xyz"]
            names += [f"right: shift along {axis}" for axis in "xyz"]
        return tuple(names)

    def camera(self, shared: NDArray[np.float64], view: str) -> Camera:
        """A view's camera."""
        return camera_of(self.model, shared[self._own(view)])

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """See RigModel; of the right view T_right_left."""
        T = np.eye(4)
        if view != self.views[0]:
            T[:3, :3], T[:3, 3] = cv2.Rodrigues(shared[-6:-3])[0], shared[-3:]
        return T

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See RigModel."""
        return _lens(self.camera(shared, view)).directions(q)

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """See RigModel."""
        own = self._own(view)
        by_shared = np.zeros((len(p), 2, len(shared)))
        if view == self.views[0]:
            q, by_shared[..., own], by_point = _project(self.model, shared[own], p)
            return Projection(q, by_shared, by_point)
        R, slopes = cv2.Rodrigues(shared[-6:-3])
        p_right = p @ R.T + shared[-3:]
        q, by_shared[..., own], by_right = _project(self.model, shared[own], p_right)
        turned = np.einsum("kij,nj->nik", slopes.reshape(3, 3, 3), p)
        by_shared[..., -6:-3] = by_right @ turned
        by_shared[..., -3:] = by_right
        return Projection(q, by_shared, by_right @ R)

    def _own(self, view: str) -> slice:
        count, index = 4 + len(COEFFICIENTS[self.model]), self.views.index(view)
        return slice(index * count, (index + 1) * count)


@dataclass(frozen=True)
class MirrorRig:
    """One camera behind a mirror for each view; the reference frame is its optical frame.

    Pixels are of the whole frame, where mirrored points are seen as they are: no image is flipped.
    Parameters: the camera's, then for each mirror two tilts, rad, and the change of its distance.
    """

    model: str
    mirrors: Mapping[str, Mirror]

    @property
    def names(self) -> tuple[str, ...]:
        """What each parameter is; as in a gel calibration."""
        names = [f"camera.{name}" for name in parameter_names(self.model)]
        for view, mirror in self.mirrors.items():
            names += [f"views.{view}.mirror: tilt towards {'xyz'[k]}" for k in tilt_axes(mirror)]
            names.append(f"views.{view}.mirror.distance")
        return tuple(names)

    def start(self, camera: Camera) -> NDArray[np.float64]:
        """The parameters of the description."""
        values = [camera_vector(camera)]
        values += [np.array([0.0, 0.0, mirror.distance]) for mirror in self.mirrors.values()]
        return np.concatenate(values)

    def scaled(self, shared: NDArray[np.float64], factor: float) -> NDArray[np.float64]:
        """The parameters of a rig with mirrors that many times as far away."""
        changed = shared.copy()
        changed[self._camera_count + 2 :: 3] *= factor
        return np.asarray(changed)

    def camera(self, shared: NDArray[np.float64]) -> Camera:
        """The one camera."""
        return camera_of(self.model, shared[: self._camera_count])

    def mirror(self, shared: NDArray[np.float64], view: str) -> Mirror:
        """A view's mirror."""
        tilts = shared[self._own(view)]
        normal = self.mirrors[view].normal + self._tilts[view].T @ tilts[:2]
        return Mirror(normal / np.linalg.norm(normal), float(tilts[2]))

    def project(self, shared: NDArray[np.float64], view: str, p: NDArray[np.float64]) -> Projection:
        """See RigModel."""
        count, own = self._camera_count, self._own(view)
        mirror, tilts = self.mirrors[view], self._tilts[view]
        raw = mirror.normal + tilts.T @ shared[own][:2]
        n = raw / np.linalg.norm(raw)
        slopes = (tilts - np.outer(tilts @ n, n)) / np.linalg.norm(raw)
        off = p @ n - shared[own][2]
        q, by_camera, by_image = _project(self.model, shared[:count], p - 2 * off[:, None] * n)
        by_mirror = np.empty((len(p), 3, 3))
        for k, slope in enumerate(slopes):
            by_mirror[..., k] = -2 * (np.outer(p @ slope, n) + off[:, None] * slope)
        by_mirror[..., 2] = 2 * n
        by_shared = np.zeros((len(p), 2, len(shared)))
        by_shared[..., :count] = by_camera
        by_shared[..., own] = by_image @ by_mirror
        return Projection(q, by_shared, by_image @ (np.eye(3) - 2 * np.outer(n, n)))

    def view_pose(self, shared: NDArray[np.float64], view: str) -> NDArray[np.float64]:
        """See RigModel."""
        return np.asarray(FLIP_X @ reflection(self.mirror(shared, view)))

    def directions(
        self, shared: NDArray[np.float64], view: str, q: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See RigModel; pixels of the whole frame."""
        del view
        directions = _lens(self.camera(shared)).directions(q)
        return np.asarray(directions * FLIP_X.diagonal()[:3])

    @cached_property
    def _tilts(self) -> dict[str, NDArray[np.float64]]:
        return {view: tilt_directions(mirror) for view, mirror in self.mirrors.items()}

    @property
    def _camera_count(self) -> int:
        return 4 + len(COEFFICIENTS[self.model])

    def _own(self, view: str) -> slice:
        first = self._camera_count + 3 * list(self.mirrors).index(view)
        return slice(first, first + 3)


def _lens(camera: Camera) -> Lens:
    """The lens of a whole image."""
    return Lens.of_view(camera, x=0, y=0, width=0, flipped=False)


def _project(
    model: str, values: NDArray[np.float64], p: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (n, 2) of points (n, 3) in a camera's frame, by its vector (C,) and by the point."""
    K = np.array([[values[0], 0, values[2]], [0, values[1], values[3]], [0, 0, 1.0]])
    points, count = p.reshape(-1, 1, 3), len(values) - 4
    if model == "equidistant":
        q, slopes = cv2.fisheye.projectPoints(points, NONE, NONE, K, values[4:])
        slopes = slopes.reshape(len(p), 2, -1)
        by_camera, by_point = slopes[..., : 4 + count], slopes[..., 7 + count : 10 + count]
    else:
        q, slopes = cv2.projectPoints(points, NONE, NONE, K, values[4:])
        slopes = slopes.reshape(len(p), 2, -1)
        by_camera, by_point = slopes[..., 6 : 10 + count], slopes[..., 3:6]
    q = np.array(q, dtype=np.float64).reshape(-1, 2)
    q[p[:, 2] <= 0] = np.nan
    return q, np.asarray(by_camera, np.float64), np.asarray(by_point, np.float64)


@dataclass(frozen=True)
class Observation:
    """Corners of one image of a view: points (n, 3) m, board frame, seen at q (n, 2) px."""

    view: str
    image: int
    points: NDArray[np.float64]
    q: NDArray[np.float64]


@dataclass(frozen=True)
class Prior:
    """What is known of the shared parameters before: mean (S,) and std (S,), inf where nothing."""

    mean: NDArray[np.float64]
    std: NDArray[np.float64]


@dataclass(frozen=True)
class Bundle:
    """The fit.

    shared (S,) with covariance (S, S); poses: T_reference_board of each image, (4, 4).
    residuals: (n, 2) px of each observation, measured minus modelled, NaN behind the camera; used:
    (n,) of each.  noise: standard deviation of a residual's coordinate, px.
    """

    shared: NDArray[np.float64]
    poses: dict[int, NDArray[np.float64]]
    residuals: list[NDArray[np.float64]]
    used: list[NDArray[np.bool_]]
    noise: float
    covariance: NDArray[np.float64]


@dataclass(frozen=True)
class _State:
    """A point of the search, its residuals and what these count, and how all that was come by.

    turned: points of each observation relative to the board's origin, reference frame.
    """

    shared: NDArray[np.float64]
    poses: dict[int, NDArray[np.float64]]
    residuals: list[NDArray[np.float64]]
    turned: list[NDArray[np.float64]]
    seen: list[Projection]
    cost: float


def adjust(
    model: RigModel,
    observations: Sequence[Observation],
    start: tuple[NDArray[np.float64], dict[int, NDArray[np.float64]]],
    prior: Prior | None = None,
) -> Bundle:
    """The most probable parameters and poses, from a start (shared, T_reference_board by image).

    First robust (Huber's loss), then plain least squares of all but outliers, by the method
    of Levenberg and Marquardt.  Raises CalibrationError where the start puts no board in front of a
    camera.
    """
    return _Adjustment(model, observations, prior).run(start)


class _Adjustment:
    def __init__(
        self, model: RigModel, observations: Sequence[Observation], prior: Prior | None
    ) -> None:
        self._model, self._observations = model, list(observations)
        count = len(model.names)
        self._prior = prior or Prior(np.zeros(count), np.full(count, np.inf))
        self._used = [np.ones(len(item.q), np.bool_) for item in self._observations]
        self._noise, self._robust = 1.0, True

    def run(self, start: tuple[NDArray[np.float64], dict[int, NDArray[np.float64]]]) -> Bundle:
        state = self._state(*start)
        if not np.isfinite(state.cost):
            msg = "board: found it behind a camera at the start of the fit, expected it in front"
            raise CalibrationError(msg)
        self._noise = self._spread(state)
        for _ in range(2):
            state = self._descend(state)
            self._noise = self._spread(state)
        self._robust = False
        for _ in range(ROUNDS):
            before = [used.copy() for used in self._used]
            self._mark(state)
            self._noise = self._deviation(state)
            state = self._descend(self._state(state.shared, state.poses))
            if all(np.array_equal(a, b) for a, b in zip(before, self._used, strict=True)):
                break
        self._noise = self._deviation(state)
        reduced, _, _ = self._equations(state)
        scale = self._scale(reduced)
        inverse = np.linalg.pinv(reduced / np.outer(scale, scale), rcond=1e-14, hermitian=True)
        covariance = inverse / np.outer(scale, scale)
        return Bundle(
            state.shared, state.poses, state.residuals, self._used, self._noise, covariance
        )

    def _state(self, shared: NDArray[np.float64], poses: dict[int, NDArray[np.float64]]) -> _State:
        turned = [item.points @ poses[item.image][:3, :3].T for item in self._observations]
        placed = [
            p + poses[item.image][:3, 3] for p, item in zip(turned, self._observations, strict=True)
        ]
        seen: list[Projection] = [NOTHING] * len(placed)
        # All images of a view at once.
        for view in dict.fromkeys(item.view for item in self._observations):
            own = [k for k, item in enumerate(self._observations) if item.view == view]
            whole = self._model.project(shared, view, np.concatenate([placed[k] for k in own]))
            ends = np.cumsum([0, *(len(placed[k]) for k in own)])
            for k, first, last in zip(own, ends[:-1], ends[1:], strict=True):
                part = slice(first, last)
                seen[k] = Projection(whole.q[part], whole.by_shared[part], whole.by_point[part])
        residuals = [item.q - part.q for item, part in zip(self._observations, seen, strict=True)]
        state = _State(shared, poses, residuals, turned, seen, 0.0)
        return replace(state, cost=self._cost(state))

    def _cost(self, state: _State) -> float:
        off = (state.shared - self._prior.mean) / self._prior.std
        cost = float(off @ off)
        for r, used in zip(state.residuals, self._used, strict=True):
            z = np.linalg.norm(r[used], axis=1) / self._noise
            if self._robust:
                cost += float(np.where(z < HUBER, z * z, 2 * HUBER * z - HUBER**2).sum())
            else:
                cost += float(z @ z)
        return cost if np.isfinite(cost) else float("inf")

    def _weights(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weights (n,) of residuals (n, 2) that are used."""
        z = np.linalg.norm(r, axis=1) / self._noise
        share = np.minimum(1.0, HUBER / np.maximum(z, HUBER)) if self._robust else np.ones(len(r))
        return np.asarray(share / self._noise**2)

    def _descend(self, state: _State) -> _State:
        state = replace(state, cost=self._cost(state))
        damping = FIRST_DAMPING
        for _ in range(MOST_STEPS):
            equations = self._blocks(state)
            while damping < MOST_DAMPING:
                found = self._stepped(state, equations, damping)
                if found.cost <= state.cost:
                    break
                damping *= 8
            else:
                return state
            gain = (state.cost - found.cost) / max(state.cost, 1e-300)
            state, damping = found, max(damping / 5, 1e-12)
            if gain < CONVERGED:
                break
        return state

    def _blocks(self, state: _State) -> _Blocks:
        count = len(state.shared)
        blocks = _Blocks(np.zeros((count, count)), np.zeros(count), {})
        inverse = 1 / self._prior.std**2
        blocks.A[np.diag_indices(count)] += inverse
        blocks.a[:] = inverse * (self._prior.mean - state.shared)
        for k, item in enumerate(self._observations):
            used, seen = self._used[k], state.seen[k]
            r = state.residuals[k][used]
            by_point = seen.by_point[used]
            by_turn = by_point @ -_cross_matrices(state.turned[k][used])
            root = np.sqrt(self._weights(r))[:, None]
            J = np.concatenate([seen.by_shared[used], by_turn, by_point], axis=2) * root[..., None]
            J = J.reshape(-1, count + 6)
            H, g = J.T @ J, J.T @ (r * root).ravel()
            blocks.add(item.image, H, g)
        return blocks

    def _stepped(self, state: _State, blocks: _Blocks, damping: float) -> _State:
        A = blocks.A + damping * np.diag(np.diag(blocks.A))
        a, solved = blocks.a.copy(), {}
        for image, (B, C, c) in blocks.images.items():
            C_damped = C + damping * np.diag(np.diag(C)) + UNSEEN
            both = np.linalg.solve(C_damped, np.concatenate([B.T, c[:, None]], axis=1))
            solved[image] = both
            A -= B @ both[:, :-1]
            a -= B @ both[:, -1]
        scale = self._scale(A)
        try:
            step = np.linalg.solve(A / np.outer(scale, scale), a / scale) / scale
        except np.linalg.LinAlgError:
            return replace(state, cost=float("inf"))
        poses = {
            image: _turned(state.poses[image], both[:, -1] - both[:, :-1] @ step)
            for image, both in solved.items()
        }
        return self._state(state.shared + step, poses)

    def _equations(self, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64], _Blocks]:
        blocks = self._blocks(state)
        A, a = blocks.A.copy(), blocks.a.copy()
        for B, C, c in blocks.images.values():
            A -= B @ np.linalg.solve(C + UNSEEN, B.T)
            a -= B @ np.linalg.solve(C + UNSEEN, c)
        return (A + A.T) / 2, a, blocks

    def _scale(self, A: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sqrt(np.maximum(np.diag(A), 1e-300))

    def _lengths(self, state: _State) -> NDArray[np.float64]:
        kept = [r[used] for r, used in zip(state.residuals, self._used, strict=True)]
        return np.asarray(np.linalg.norm(np.concatenate(kept), axis=1))

    def _spread(self, state: _State) -> float:
        return max(float(np.median(self._lengths(state)) / MEDIAN_LENGTH), LEAST_NOISE_PX)

    def _deviation(self, state: _State) -> float:
        lengths = self._lengths(state)
        known = len(state.shared) + 6 * len(state.poses)
        free = max(2 * len(lengths) - known, 1)
        return max(float(np.sqrt(lengths @ lengths / free)), LEAST_NOISE_PX)

    def _mark(self, state: _State) -> None:
        lengths = np.concatenate([np.linalg.norm(r, axis=1) for r in state.residuals])
        spread = float(np.nanmedian(lengths)) / MEDIAN_LENGTH
        limit = max(OUTLIER * spread, LEAST_OUTLIER_PX)
        self._used = [np.linalg.norm(r, axis=1) <= limit for r in state.residuals]
        images = [item.image for item in self._observations]
        left = np.bincount(images, [np.count_nonzero(used) for used in self._used])
        for k, image in enumerate(images):
            if left[image] < FEWEST_CORNERS:
                self._used[k] = np.zeros_like(self._used[k])


@dataclass(frozen=True)
class _Blocks:
    """Normal equations: A (S, S), a (S,) of the shared parameters; B, C, c of each image's pose."""

    A: NDArray[np.float64]
    a: NDArray[np.float64]
    images: dict[int, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]

    def add(self, image: int, H: NDArray[np.float64], g: NDArray[np.float64]) -> None:
        """Add an observation's J^T J and J^T r; their last six entries are of the pose."""
        self.A.__iadd__(H[:-6, :-6])
        self.a.__iadd__(g[:-6])
        parts = H[:-6, -6:], H[-6:, -6:], g[-6:]
        if image in self.images:
            B, C, c = self.images[image]
            parts = B + parts[0], C + parts[1], c + parts[2]
        self.images[image] = parts


def _turned(T: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """A pose turned about its own origin by a rotation vector, then shifted."""
    moved = np.eye(4)
    moved[:3, :3] = cv2.Rodrigues(step[:3])[0] @ T[:3, :3]
    moved[:3, 3] = T[:3, 3] + step[3:]
    return moved


def _cross_matrices(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3) that map a vector to p x vector."""
    M = np.zeros((len(p), 3, 3))
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = -p[:, 2], p[:, 1], -p[:, 0]
    return np.asarray(M - M.transpose(0, 2, 1))
