"""The joint fit: derivatives, outliers, what the data show and what they cannot."""

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_bringup.calibration.practice import board_poses
from cmp_tactile_processing.calibration.board.bundle import Observation, adjust
from cmp_tactile_processing.calibration.outcome import rig_estimates
from cmp_tactile_processing.geometry.optics import build_views
from cmp_tactile_processing.geometry.rig_parameters import RigParameters, RigPrior

NOISE_PX = 0.02
PRIOR = RigPrior(turn=0.09, shift=2e-3, focal=0.1, aspect=0.1, principal_point=50.0, distortion=0.5)

HELD = RigPrior(turn=1e-12, shift=1e-12, focal=1e-12, principal_point=1e-12)


@pytest.fixture(scope="module")
def problem(built, described, chessboard):
    """Corners with noise in a built rig, and the fit's start at its description."""
    rng = np.random.default_rng(7)
    observations, poses = [], {}
    for image, T_gel_board in enumerate(board_poses(built, chessboard, 12, seed=5)):
        poses[image] = T_gel_board
        p = chessboard.points @ T_gel_board[:3, :3].T + T_gel_board[:3, 3]
        for name, view in build_views(built).items():
            q = view.project(p) + rng.normal(0, NOISE_PX, (len(p), 2))
            observations.append(Observation(name, image, chessboard.points, q))
    # The gel is where it is in the built rig: the boards' poses are counted from it.
    optics = replace(described.optics, T_camera_gel=built.optics.T_camera_gel)
    rig = RigParameters(replace(described, optics=optics), PRIOR, held=("gel",))
    return rig, observations, (np.zeros(len(rig.free)), poses)


@pytest.fixture(scope="module")
def clean(problem):
    return adjust(*problem)


def test_errors_are_as_large_as_the_covariance_says(clean, problem, built):
    rig, *_ = problem
    assert clean.noise == pytest.approx(NOISE_PX, rel=0.05)
    found, true = rig.sensor(clean.fit.values).camera, built.camera
    std = {item.name: item.std for item in rig_estimates(rig, clean.fit)}
    for name in ("fx", "cx", "cy"):
        assert abs(getattr(found, name) - getattr(true, name)) < 3.5 * std[f"camera.{name}"]
    assert found.fx == pytest.approx(true.fx, rel=1e-3)
    assert found.fy == pytest.approx(true.fy, rel=1e-3)


def test_squares_grow_as_the_covariance_says_while_the_boards_follow(clean, problem):
    """A slope that forgot how the boards follow the rig would say too much."""
    rig, observations, (_, poses) = problem
    fit, least = clean.fit, np.sum(np.square(np.concatenate(clean.residuals)))
    information = np.linalg.inv(fit.covariance) - np.diag(fit.prior_std**-2.0)
    # What the prior alone holds may be off by degrees, and is curved.
    shown = [item for item in fit.combinations if not item.held]
    for draws in np.random.default_rng(3).normal(size=(4, len(shown))):
        steps = [
            draw * item.share * item.direction for draw, item in zip(draws, shown, strict=True)
        ]
        step = fit.prior_std * np.sum(steps, axis=0)
        held = RigParameters(rig.sensor(fit.values + step), HELD, held=("gel",))
        other = adjust(held, observations, (np.zeros(len(held.free)), poses))
        grown = np.sum(np.square(np.concatenate(other.residuals))) - least
        assert grown / clean.noise**2 == pytest.approx(step @ information @ step, rel=0.02)


def test_the_joint_turn_of_the_mirrors_stays_open(clean, problem):
    """The rotation of both mirrors about their common line: its deviation is the prior's."""
    rig, *_ = problem
    loose, *others = clean.fit.combinations
    assert loose.share == pytest.approx(1.0, abs=0.02)
    assert max(item.share for item in others) < 0.1
    at, way = clean.fit.values, 1e-4 * loose.direction * clean.fit.prior_std
    before, after = (
        [view.mirror.normal for view in rig.sensor(values).views.values()]
        for values in (at, at + way)
    )
    axis = np.cross(*before) / np.linalg.norm(np.cross(*before))
    turns = [np.cross(n, moved) for n, moved in zip(before, after, strict=True)]
    for turn in turns:
        assert abs(turn @ axis) == pytest.approx(np.linalg.norm(turn), rel=1e-3)
    assert turns[0] @ turns[1] > 0


def test_outliers_are_marked_and_change_nothing(clean, problem):
    rig, observations, start = problem
    spoilt = [replace(item, q=item.q.copy()) for item in observations]
    spoilt[3].q[10] += (1.5, -1.0)
    spoilt[8].q[20] += (30.0, 0.0)
    found = adjust(rig, spoilt, start)
    out = [(k, int(n)) for k, used in enumerate(found.used) for n in np.flatnonzero(~used)]
    assert out == [(3, 10), (8, 20)]
    assert (np.abs(found.fit.values - clean.fit.values) / clean.fit.std).max() < 0.3


def test_an_image_of_which_few_corners_fit_counts_for_nothing(clean, problem):
    """All but five corners of one image are far off: the five would place its board anyhow."""
    rig, observations, start = problem
    image = observations[4].image
    spoilt = [
        replace(item, q=np.concatenate([item.q[:3], item.q[3:] + (40.0, -30.0)]))
        if item.image == image
        else item
        for item in observations
    ]
    found = adjust(rig, spoilt, start)
    left = [
        used.any() for item, used in zip(spoilt, found.used, strict=True) if item.image == image
    ]
    assert left == [False, False]
    assert (np.abs(found.fit.values - clean.fit.values) / clean.fit.std).max() < 1.5
