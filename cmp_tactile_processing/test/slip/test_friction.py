"""Friction used by a contact, and how far it slips, against closed forms on a disc of nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.measured import Contact
from cmp_tactile_processing.slip.friction import Sliding, friction_use, patch_of, slip_profile
from cmp_tactile_processing.slip.surface_motion import DeformedNodes

RADIUS = 2e-3
FRICTION = 0.6
FLAT_AXES = np.eye(3)[:, :2]
# A disc of 60 nodes across differs from the continuum by this.
DISC_TOLERANCE = 0.02


@pytest.fixture(scope="module")
def arm():
    x = np.linspace(-RADIUS, RADIUS, 61)
    points = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    return points[(points**2).sum(axis=1) < RADIUS**2]


@pytest.fixture(scope="module")
def radius(arm):
    return np.sqrt((arm**2).sum(axis=1)) / RADIUS


@pytest.fixture(scope="module")
def pressing(radius):
    """Hertz."""
    return 1e-3 * np.sqrt(1 - radius**2)


@pytest.fixture(scope="module")
def flat(pressing, arm):
    normal = np.tile([0.0, 0.0, 1.0], (len(arm), 1))
    return Sliding.from_loads(pressing, arm, normal, FLAT_AXES)


def _along(direction, pressing):
    """Full friction along directions (k, 2), as (k, 3) N."""
    unit = direction / np.linalg.norm(direction, axis=1)[:, None]
    return FRICTION * pressing[:, None] * np.column_stack([unit, np.zeros(len(unit))])


@pytest.mark.parametrize("pivot_radii", [np.inf, 1.1, 0.0])
def test_all_that_slides_uses_its_friction_whatever_the_motion(flat, pressing, arm, pivot_radii):
    """From a straight motion over pivots beside and inside the contact to pure torsion."""
    if np.isinf(pivot_radii):
        direction = np.tile([0.8, -0.6], (len(arm), 1))
    else:
        # Not on a node: there the direction has no meaning.
        relative = arm - (pivot_radii * RADIUS + 1e-6, 2e-6)
        direction = np.stack([-relative[:, 1], relative[:, 0]], axis=1)
    use = friction_use(flat, _along(direction, pressing), blur=1e-6)
    assert use.ratio == pytest.approx(FRICTION, rel=2e-3)
    assert use.width == pytest.approx(1.0, abs=2e-3)
    assert use.turning == pytest.approx(0 if np.isinf(pivot_radii) else use.turning, abs=1e-6)


def test_all_that_slides_uses_its_friction_on_a_slope(pressing, arm):
    """A ball's curve turns normals by up to 0.4 rad and friction runs along the surface."""
    normal = np.column_stack([0.4 * arm / RADIUS, np.ones(len(arm))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    along = np.array([1.0, 0.0, 0.0]) - normal[:, :1] * normal
    along *= FRICTION * pressing[:, None] / np.linalg.norm(along, axis=1)[:, None]
    use = friction_use(Sliding.from_loads(pressing, arm, normal, FLAT_AXES), along, blur=1e-6)
    assert use.ratio == pytest.approx(FRICTION, rel=1e-3)
    assert use.width == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("core", [0.9, 0.7, 0.5, 0.3])
def test_a_partly_sliding_ball_is_read_as_cattaneo_and_mindlin_tell(flat, pressing, radius, core):
    """t = mu (p(a) - p(c)): the rim of (1 - c^2)^(3/2) of the normal force slides."""
    inner = 1e-3 * np.sqrt(np.maximum(core**2 - radius**2, 0.0))
    along = np.zeros((len(radius), 3))
    along[:, 1] = FRICTION * (pressing - inner)
    use = friction_use(flat, along, blur=1e-6)
    assert use.ratio == pytest.approx(FRICTION * (1 - core**3), rel=DISC_TOLERANCE)
    assert use.width == pytest.approx((1 - core**5) / (1 - core**3), rel=DISC_TOLERANCE)
    profile = slip_profile(flat)
    slip_ratio, used = profile.at(use)
    assert slip_ratio == pytest.approx((1 - core**2) ** 1.5, abs=DISC_TOLERANCE)
    assert use.ratio / used == pytest.approx(FRICTION, rel=DISC_TOLERANCE)


def _torsion(core, at):
    """Traction of torsion over friction under Hertz's pressure, whose core sticks; at: radii.

    Flat stamps of radius s that turn leave r / (s^2 - r^2)^(1/2); those from 0 to 1 that add up to
    the pressure are found first, and those below the core's radius then left out.
    """
    edge = np.linspace(0, 1, 401)
    r = edge[:-1] + 0.25 / 400
    reach = np.arccosh(np.maximum(edge[None, :] / r[:, None], 1.0))
    stamps = np.diff(reach, axis=1)
    weight = np.linalg.solve(stamps, np.sqrt(1 - r**2) / r)
    weight[edge[:-1] < core] = 0.0
    return np.interp(at, r, r * (stamps @ weight))


@pytest.mark.parametrize("core", [0.9, 0.7, 0.5, 0.3])
def test_a_partly_sliding_turn_is_read_by_its_own_spread(flat, radius, arm, core):
    along = np.zeros((len(arm), 3))
    along[:, 0], along[:, 1] = -arm[:, 1], arm[:, 0]
    along *= (1e-3 * _torsion(core, radius) / np.maximum(radius, 1e-9))[:, None] / RADIUS
    use = friction_use(flat, along, blur=1e-6)
    assert use.turning == pytest.approx(1.0, abs=1e-6)
    slip_ratio, _ = slip_profile(flat).at(use)
    assert slip_ratio == pytest.approx((1 - core**2) ** 1.5, abs=0.05)


def test_a_flat_face_does_not_tell_sticking_from_sliding(arm, pressing, radius):
    normal = np.tile([0.0, 0.0, 1.0], (len(arm), 1))
    stamp = 1e-3 / np.sqrt(np.maximum(1 - radius**2, 0.1))
    assert slip_profile(Sliding.from_loads(pressing, arm, normal, FLAT_AXES)).is_rounded
    assert not slip_profile(Sliding.from_loads(stamp, arm, normal, FLAT_AXES)).is_rounded


GRID = np.stack(np.meshgrid(*2 * (1e-3 * np.arange(5.0),)), axis=-1).reshape(-1, 2)
PLACE = np.column_stack([GRID, np.zeros(25)])
CONTACT = Contact(
    nodes=np.arange(25),
    wrench=np.zeros(6),
    covariance=np.full((6, 6), np.nan),
    area=1e-5,
    centre_of_pressure=np.zeros(3),
    outline=np.empty((0, 3)),
    at_border=False,
)


def _patch(force, place=PLACE, contact=CONTACT):
    normal = np.tile([0.0, 0.0, 1.0], (25, 1))
    return patch_of(contact, force, DeformedNodes(GRID, place, normal, np.ones(25), 1e-3))


def test_the_friction_used_is_as_certain_as_its_forces() -> None:
    """Monte Carlo: 0.75 N of drag and 2 N of press, of deviations that are not the same."""
    force, std = np.tile([0.03, 0.0, -0.08], (25, 1)), np.array([0.02, 0.02, 0.1])
    covariance = np.diag([*std**2, 0.0, 0.0, 0.0])
    drawn = np.random.default_rng(2).normal(force.sum(axis=0), std, (20_000, 3))
    expected = np.std(np.hypot(drawn[:, 0], drawn[:, 1]) / -drawn[:, 2])
    found = _patch(force, contact=replace(CONTACT, covariance=covariance)).ratio_std
    assert found == pytest.approx(expected, rel=0.03)


def test_a_node_of_unknown_place_makes_the_contact_unknown() -> None:
    """Its normal may be known all the same, from its neighbours; all figures would be NaN."""
    force = np.tile([0.01, 0.0, -0.1], (25, 1))
    assert _patch(force)
    place = PLACE.copy()
    place[12] = np.nan
    assert _patch(force, place) is None


def test_forces_that_grow_together_use_no_friction() -> None:
    """A press that goes on pulls its nodes outwards in proportion; only what is beyond that counts.

    Friction by 0.1 of a normal force that doubles, then 0.2 N along y beside 5 N.
    """
    force = np.tile([0.01, 0.0, -0.1], (25, 1))
    before = _patch(force).record()
    assert _patch(2 * force).use.ratio == pytest.approx(0.1)
    assert _patch(2 * force).since(before).ratio == pytest.approx(0.0, abs=1e-12)
    more = 2 * force + [0.0, 8e-3, 0.0]
    assert _patch(more).since(before).ratio == pytest.approx(0.04)
