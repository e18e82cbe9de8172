"""Where the fit of a board calibration starts: poses of the board, and cameras without a rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cmp_tactile_processing.calibration.board.bundle import Bundle, Observation, adjust
from cmp_tactile_processing.calibration.board.target import BoardTarget
from cmp_tactile_processing.geometry.optics import ViewGeometry, view_geometry
from cmp_tactile_processing.geometry.rig_parameters import RigParameters
from cmp_tactile_processing.measured import ViewPlacement
from cmp_tactile_processing.sensor.parts import Camera

# Rounds of choosing poses and fitting: poses chosen with a rough rig may turn out wrong.
ROUNDS = 3
# Images that a first calibration of a single camera is made of; more change nothing in a start.
FIRST_IMAGES = 30


@dataclass(frozen=True)
class Corners:
    """Corners of a board in an image: number (n,) and place q (n, 2), px of the view."""

    number: NDArray[np.intp]
    q: NDArray[np.float64]


@dataclass(frozen=True)
class RigFit:
    """A fitted rig and what it was fitted to."""

    bundle: Bundle
    observations: list[Observation]


@dataclass(frozen=True)
class _Choice:
    """A pose of the board in an image and the symmetry by which each view numbers its corners."""

    pose: NDArray[np.float64]
    symmetry: tuple[int, ...]
    error: float


def fit_rig(
    rig: RigParameters,
    changes: NDArray[np.float64],
    target: BoardTarget,
    images: Mapping[int, Mapping[str, Corners]],
) -> RigFit | None:
    """Fit a rig to images, each with corners by view; None where no image fits the start at all.

    changes: where to start.  Poses of the board, and how a board that looks the same turned round
    is numbered in the second view, are chosen again with each rig until they stay.
    """
    fit, before = None, None
    for _ in range(ROUNDS):
        views = rig.views(changes)
        found = {image: _choose(views, target, seen) for image, seen in images.items()}
        choices = {image: choice for image, choice in found.items() if choice is not None}
        if not choices:
            return None
        symmetries = {image: choice.symmetry for image, choice in choices.items()}
        poses = {image: choice.pose for image, choice in choices.items()}
        if fit is not None and symmetries == before and _alike(poses, fit.bundle.poses):
            break
        observations = [
            Observation(view, image, target.points[target.symmetries[turn][seen.number]], seen.q)
            for image, choice in choices.items()
            for (view, seen), turn in zip(images[image].items(), choice.symmetry, strict=True)
        ]
        bundle = adjust(rig, observations, (changes, poses))
        fit, changes, before = RigFit(bundle, observations), bundle.fit.values, symmetries
    return fit


def start_error(
    views: Mapping[str, ViewGeometry],
    target: BoardTarget,
    images: Mapping[int, Mapping[str, Corners]],
) -> float:
    """Median RMS distance, px, of corners from where views have them; infinite for none."""
    found = [_choose(views, target, seen) for seen in images.values()]
    errors = [choice.error for choice in found if choice is not None]
    return float(np.median(errors)) if errors else float("inf")


def _alike(a: Mapping[int, NDArray[np.float64]], b: Mapping[int, NDArray[np.float64]]) -> bool:
    """Whether no pose turned by more than a tenth of a radian, which another solution does."""
    if a.keys() != b.keys():
        return False
    return all(np.trace(a[k][:3, :3].T @ b[k][:3, :3]) > 1 + 2 * np.cos(0.1) for k in a)


def _choose(
    views: Mapping[str, ViewGeometry], target: BoardTarget, seen: Mapping[str, Corners]
) -> _Choice | None:
    """The pose, of those that each view suggests, that fits all views best."""
    symmetries, points = target.symmetries, target.points
    best: _Choice | None = None
    for view, corners in seen.items():
        T_gel_view = np.linalg.inv(views[view].T_view_gel)
        # The first view is numbered as it is: turning the board changes nothing.
        own = range(1 if view == next(iter(seen)) else len(symmetries))
        for turn in own:
            p = points[symmetries[turn][corners.number]]
            for T_view_board in _plane_poses(p, views[view].lens.directions(corners.q)):
                choice = _judged(views, target, seen, T_gel_view @ T_view_board)
                if choice is not None and (best is None or choice.error < best.error):
                    best = choice
    return best


def _judged(
    views: Mapping[str, ViewGeometry],
    target: BoardTarget,
    seen: Mapping[str, Corners],
    pose: NDArray[np.float64],
) -> _Choice | None:
    """A pose with the symmetry that suits it best in each view; None where one does not see it."""
    placed = _moved(pose, target.points)
    errors2, turns = [], []
    for index, (view, corners) in enumerate(seen.items()):
        q = views[view].project(placed)
        options = target.symmetries if index else target.symmetries[:1]
        off = [q[order[corners.number]] - corners.q for order in options]
        means = [float((residual**2).sum(axis=1).mean()) for residual in off]
        turns.append(int(np.argmin(means)))
        errors2.append(min(means))
    error = float(np.sqrt(np.mean(errors2)))
    return _Choice(pose, tuple(turns), error) if np.isfinite(error) else None


def _plane_poses(
    p: NDArray[np.float64], directions: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """The two poses T_view_board of a plane that fit best, from points and their directions."""
    with np.errstate(invalid="ignore"):
        ahead = directions[:, 2] > 1e-3
    if np.count_nonzero(ahead) < 4:
        return []
    xy = directions[ahead, :2] / directions[ahead, 2:]
    try:
        count, turns, shifts, _ = cv2.solvePnPGeneric(
            p[ahead].reshape(-1, 1, 3),
            xy.reshape(-1, 1, 2),
            np.eye(3),
            None,
            flags=cv2.SOLVEPNP_IPPE,
        )
    except cv2.error:  # corners on one line
        return []
    poses = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        if np.isfinite(T).all():
            poses.append(T)
    return poses


def start_of_cameras(
    model: str,
    target: BoardTarget,
    images: Mapping[int, Mapping[str, Corners]],
    sizes: Mapping[str, tuple[int, int]],
) -> tuple[dict[str, Camera], NDArray[np.float64]]:
    """Plain cameras by view and T_right_left (4, 4), from their images alone, by OpenCV.

    model: pinhole or equidistant.  sizes: width and height of each view's images, px.  The pose is
    the identity for one camera.
    """
    cameras, poses = {}, {}
    for view, size in sizes.items():
        seen = {image: views[view] for image, views in images.items() if view in views}
        camera, poses[view] = _one_camera(target, seen, size)
        cameras[view] = _as_model(model, camera)
    if len(cameras) < 2:
        return cameras, np.eye(4)
    return cameras, _most_agreed(target, *poses.values())


def _one_camera(
    target: BoardTarget, seen: Mapping[int, Corners], size: tuple[int, int]
) -> tuple[Camera, dict[int, NDArray[np.float64]]]:
    """One pinhole camera, and T_view_board of its images."""
    chosen = list(seen)[:: max(1, -(-len(seen) // FIRST_IMAGES))]
    _, K, distortion, _, _ = cv2.calibrateCamera(
        [target.points[seen[image].number].astype(np.float32) for image in chosen],
        [seen[image].q.astype(np.float32).reshape(-1, 1, 2) for image in chosen],
        size,
        np.eye(3),
        np.zeros(5),
    )
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = Camera("pinhole", fx, fy, cx, cy, tuple(np.ravel(distortion)[:5].tolist()))
    placement = ViewPlacement(0, 0, *size, flipped=False)
    view = {"left": view_geometry("left", camera, placement, np.eye(4))}
    poses = {}
    for image, corners in seen.items():
        choice = _choose(view, target, {"left": corners})
        if choice is not None:
            poses[image] = choice.pose
    return camera, poses


def _as_model(model: str, pinhole: Camera) -> Camera:
    """A pinhole camera as one of another model, alike near the image's middle."""
    if model == "pinhole":
        return pinhole
    # tan a = a + a^3 / 3 + ...
    return replace(pinhole, model=model, distortion=(pinhole.distortion[0] + 1 / 3, 0.0, 0.0, 0.0))


def _most_agreed(
    target: BoardTarget,
    left: Mapping[int, NDArray[np.float64]],
    right: Mapping[int, NDArray[np.float64]],
) -> NDArray[np.float64]:
    """T_right_left that most images agree on, whichever way round each numbers the board."""
    turns = [_turn_of(target, order) for order in target.symmetries]
    shared = sorted(left.keys() & right.keys())
    suggested = {
        image: [right[image] @ turn @ np.linalg.inv(left[image]) for turn in turns]
        for image in shared
    }
    hypotheses = [T for options in suggested.values() for T in options]

    def disagreement(T: NDArray[np.float64]) -> float:
        return float(np.median([min(_apart(T, S) for S in suggested[k]) for k in shared]))

    return min(hypotheses, key=disagreement)


def _apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """How far two poses are apart: turn, rad, and shift as a share of the way."""
    turn = np.arccos(np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1, 1))
    way = max(float(np.linalg.norm(a[:3, 3])), 1e-9)
    return float(turn + np.linalg.norm(a[:3, 3] - b[:3, 3]) / way)


def _turn_of(target: BoardTarget, order: NDArray[np.intp]) -> NDArray[np.float64]:
    """(4, 4): the board's motion that takes each corner to that of its number in `order`."""
    centre = target.points.mean(axis=0)
    for quarter in range(4):
        c, s = np.cos(quarter * np.pi / 2), np.sin(quarter * np.pi / 2)
        T = np.eye(4)
        T[:2, :2] = np.array([[c, -s], [s, c]]).round()
        T[:3, 3] = centre - T[:3, :3] @ centre
        if np.allclose(_moved(T, target.points), target.points[order], atol=1e-3 * target.square):
            return T
    raise AssertionError(order)


def _moved(T: NDArray[np.float64], p: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(p @ T[:3, :3].T + T[:3, 3])
