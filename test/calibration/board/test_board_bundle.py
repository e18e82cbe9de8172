"""The joint fit: derivatives, outliers, what the data show and what they cannot."""

import numpy as np
import pytest

from cmp_tactile_bringup.calibration.practice_rig import board_poses
from cmp_tactile_processing.calibration.board.bundle import (
    CameraPair,
    MirrorRig,
    Observation,
    Prior,
    adjust,
)
from cmp_tactile_processing.geometry.optics import build_views

STEP = 1e-6
PINHOLE = [700.0, 710.0, 320.0, 240.0, -0.1, 0.03, 1e-3, -2e-3, 0.01]
EQUIDISTANT = [600.0, 610.0, 320.0, 240.0, 0.05, -0.02, 0.01, -0.003]
POSE = [0.1, -0.3, 0.05, -0.02, 0.003, 0.001]
NOISE_PX = 0.02


def _models(described):
    mirrors = {name: view.mirror for name, view in described.views.items()}
    tilts = [0.01, -0.02, -0.0101, -0.01, 0.015, -0.0095]
    yield CameraPair("pinhole", ("left", "right")), [*PINHOLE, *PINHOLE, *POSE], 0.1
    yield CameraPair("equidistant", ("left", "right")), [*EQUIDISTANT, *EQUIDISTANT, *POSE], 0.1
    yield MirrorRig("pinhole", mirrors), [*PINHOLE, *tilts], -0.002
    yield MirrorRig("equidistant", mirrors), [*EQUIDISTANT, *tilts], -0.002


def test_derivatives_are_those_of_finite_differences(described):
    rng = np.random.default_rng(0)
    for model, values, distance in _models(described):
        shared = np.array(values)
        p = rng.uniform(-0.1, 0.1, (6, 3)) * abs(distance) + (0, 0, distance)
        for view in ("left", "right"):
            found = model.project(shared, view, p)
            assert np.isfinite(found.q).all()
            for k, off in enumerate(np.eye(len(shared)) * STEP):
                slope = (
                    model.project(shared + off, view, p).q - model.project(shared - off, view, p).q
                ) / (2 * STEP)
                scale = max(np.abs(slope).max(), 1.0)
                np.testing.assert_allclose(found.by_shared[..., k], slope, atol=1e-5 * scale)
            for k, off in enumerate(np.eye(3) * 1e-8):
                slope = (
                    model.project(shared, view, p + off).q - model.project(shared, view, p - off).q
                ) / 2e-8
                scale = np.abs(found.by_point).max()
                np.testing.assert_allclose(found.by_point[..., k], slope, atol=1e-5 * scale)


@pytest.fixture(scope="module")
def problem(built, described, chessboard):
    """Corners with noise in a built rig, and the fit's start at its description."""
    rng = np.random.default_rng(7)
    model = MirrorRig("pinhole", {name: view.mirror for name, view in described.views.items()})
    observations, poses = [], {}
    for image, T_gel_board in enumerate(board_poses(built, chessboard, 12, seed=5)):
        poses[image] = built.optics.T_camera_gel @ T_gel_board
        p = chessboard.points @ T_gel_board[:3, :3].T + T_gel_board[:3, 3]
        for name, view in build_views(built).items():
            q = view.placement.to_frame(view.project(p)) + rng.normal(0, NOISE_PX, (len(p), 2))
            observations.append(Observation(name, image, chessboard.points, q))
    start = model.start(described.camera)
    std = np.array([70, 70, 50, 50, 0.5, 0.5, 0.05, 0.05, 0.5, *([0.09, 0.09, 2e-3] * 2)])
    return model, observations, (start, poses), Prior(start, std)


def test_errors_are_as_large_as_the_covariance_says(problem, built):
    model, observations, start, prior = problem
    fit = adjust(model, observations, start, prior)
    assert fit.noise == pytest.approx(NOISE_PX, rel=0.05)
    true = model.start(built.camera)[:9]
    deviations = (fit.shared[:9] - true) / np.sqrt(np.diag(fit.covariance)[:9])
    # 9 correlated numbers of a normal distribution.
    assert np.abs(deviations).max() < 3.5
    assert np.abs(fit.shared[:2] / true[:2] - 1).max() < 1e-3


def test_the_joint_turn_of_the_mirrors_stays_open(problem):
    """The rotation of both mirrors about their common line: its deviation is the prior's."""
    model, observations, start, prior = problem
    fit = adjust(model, observations, start, prior)
    relative = fit.covariance / np.outer(prior.std, prior.std)
    values, directions = np.linalg.eigh(relative)
    assert values[-1] == pytest.approx(1.0, abs=0.02)
    assert values[-2] < 0.01
    n, other = (model.mirror(fit.shared, view).normal for view in ("left", "right"))
    axis = np.cross(n, other)
    turns = []
    for view, normal in (("left", n), ("right", other)):
        own = 9 + 3 * list(model.mirrors).index(view)
        step = np.zeros(len(fit.shared))
        step[own : own + 3] = (directions[:, -1] * prior.std)[own : own + 3]
        moved = model.mirror(fit.shared + 1e-4 * step, view).normal
        turns.append(np.cross(normal, moved) / np.linalg.norm(moved - normal))
    for turn in turns:
        assert abs(turn @ axis) / np.linalg.norm(axis) == pytest.approx(1.0, abs=1e-3)
    assert turns[0] @ turns[1] > 0


def test_outliers_are_marked_and_change_nothing(problem):
    model, observations, start, prior = problem
    clean = adjust(model, observations, start, prior)
    spoilt = [Observation(o.view, o.image, o.points, o.q.copy()) for o in observations]
    spoilt[3].q[10] += (1.5, -1.0)
    spoilt[8].q[20] += (30.0, 0.0)
    fit = adjust(model, spoilt, start, prior)
    out = [(k, int(n)) for k, used in enumerate(fit.used) for n in np.flatnonzero(~used)]
    assert out == [(3, 10), (8, 20)]
    change = np.abs(fit.shared - clean.shared) / np.sqrt(np.diag(clean.covariance))
    assert change.max() < 0.3
