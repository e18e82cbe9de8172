"""What two fingers say of a grasp, against wrenches in equilibrium with a known load."""

from dataclasses import replace

import numpy as np
import pytest
from made_forces import made_field
from scipy.spatial.transform import Rotation

from cmp_tactile_processing.force.grasp import (
    Finger,
    GraspEstimator,
    GraspFlag,
    friction_use,
    torsion_radius,
)
from cmp_tactile_processing.measured import NS_PER_S, ForceFlag, SlipEstimate, SlipState

AXIS = np.array([0.0, -1.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
# Of each component of a wrench, N and N m.
STD = np.array([0.02, 0.03, 0.05, 1e-4, 2e-4, 3e-4])
STICK = SlipEstimate(SlipState.STICK)
SAMPLES = 4000
# Of a standard deviation from so many samples, four times its own.
STD_TOLERANCE = 4 / np.sqrt(2 * SAMPLES)


def pose(normal, place, turn=0.0):
    """A gel frame at a place, its z along the normal, turned about it."""
    across = np.cross(normal, UP)
    turned = Rotation.from_rotvec(turn * normal).apply([across, np.cross(normal, across)])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([*turned, normal])
    T[:3, 3] = place
    return T


LEFT, RIGHT = pose(AXIS, [0, 0.02, 0]), pose(-AXIS, [0, -0.02, 0], 1.0)


def disc(radius, nodes=61, pressure=lambda _: 1.0):
    """Nodes (rows, cols) and their pressed forces of 1 N altogether on a disc."""
    x, y = np.meshgrid(*2 * [np.linspace(-radius, radius, nodes)])
    inside = np.hypot(x, y) <= radius
    force = np.zeros((*x.shape, 3))
    force[inside, 2] = -1.0
    force[..., 2] *= pressure(np.hypot(x, y) / radius)
    force /= -force[..., 2].sum()
    position = np.stack([x, y, 0 * x], axis=-1)
    return {
        "position": position.reshape(-1, 3),
        "force": force.reshape(-1, 3),
        "contact": inside.ravel(),
    }


def finger(T, wrench, *, centre=(0, 0, 0), reference=(0.001, -0.002, 0.003), **fields):
    """A finger with a wrench (6,) on its gel, about the origin of the common frame."""
    R, centre, reference = T[:3, :3], np.array(centre, float), np.array(reference, float)
    moment = wrench[3:] - np.cross(R @ reference + T[:3, 3], wrench[:3])
    own = np.concatenate([wrench[:3] @ R, moment @ R])
    given = {
        "wrench": own,
        "wrench_covariance": np.diag(STD**2),
        "systematic_covariance": np.zeros((6, 6)),
        "centre_of_pressure": centre,
        "reference_point": reference,
        "slip": STICK,
        **disc(0.003, 11),
        **fields,
    }
    return Finger(made_field(11, 11, **given), T)


def at(point, force, moment=(0, 0, 0)):
    """A wrench (6,) about the origin of a force at a point and a moment."""
    return np.concatenate([force, np.cross(point, force) + moment])


def grip(normal=3.0, load=(0.2, 0.0, -1.4), turning=0.004, **fields):
    """Two fingers that share a load and a torque about the axis."""
    half = at([0, 0, 0], np.array(load) / 2, turning / 2 * AXIS)
    return (
        finger(LEFT, half - at([0, 0, 0], normal * AXIS), **fields),
        finger(RIGHT, half + at([0, 0, 0], normal * AXIS), **fields),
    )


def test_load_and_torque_are_those_that_hold_the_object_in_any_pose():
    """A weight off the grip axis and a torque, shared between the fingers by chance."""
    random = np.random.default_rng(3)
    for _ in range(20):
        turn = Rotation.random(random_state=random.integers(1 << 30)).as_matrix()
        place = random.normal(0, 0.1, 3)
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = turn, place
        axis = turn @ AXIS
        middle, aside = place + random.normal(0, 0.01, 3), random.normal(0, 0.003, (2, 3))
        load = at(middle, turn @ [0.0, 0.1, -1.5], random.normal(0, 0.01, 3))
        on_left = at(place, random.normal(0, 0.5, 3) - 4 * axis, random.normal(0, 0.01, 3))
        poses = whole @ pose(AXIS, [0, 0.02, 0], 0.3), whole @ pose(-AXIS, [0, -0.02, 0], -2.0)
        left = finger(poses[0], on_left, centre=aside[0])
        right = finger(poses[1], load - on_left, centre=aside[1])
        found = GraspEstimator().update(left, right, 0, turn @ UP)
        np.testing.assert_allclose(found.grip_axis, axis, atol=1e-12)
        on_right = load - on_left
        assert found.grip_force == pytest.approx((on_right - on_left)[:3] @ axis / 2)
        np.testing.assert_allclose(found.load[:3], load[:3], atol=1e-12)
        # The moment of the load about the centre of contact.
        about = load[3:] - np.cross(found.centre_of_contact, load[:3])
        np.testing.assert_allclose(found.load[3:], about, atol=1e-12)
        assert found.grip_torque == pytest.approx(about @ axis)
        across = found.load_across
        assert across @ axis == pytest.approx(0, abs=1e-12)
        np.testing.assert_allclose(across + (load[:3] @ axis) * axis, load[:3], atol=1e-12)
        pressed = np.maximum(0, found.normal_force)
        centres = [T[:3, :3] @ c + T[:3, 3] for T, c in zip(poses, aside, strict=True)]
        np.testing.assert_allclose(found.centre_of_contact, pressed @ centres / pressed.sum())
        assert found.usable


def test_errors_are_those_of_many_noisy_wrenches():
    random = np.random.default_rng(5)
    fingers = grip(systematic_covariance=np.zeros((6, 6)))
    exact = GraspEstimator().update(*fingers, 0, UP, 0.8)
    found = []
    for _ in range(SAMPLES):
        noisy = [
            replace(f, field=replace(f.field, wrench=f.field.wrench + STD * random.normal(size=6)))
            for f in fingers
        ]
        state = GraspEstimator().update(*noisy, 0, UP, 0.8)
        ratios = [friction_use(f.field)[0] for f in noisy]
        found.append([state.grip_force, *state.load[:3], state.grip_torque, ratios[0]])
    stds = [exact.grip_force_std, *np.sqrt(np.diag(exact.load_covariance)[:3])]
    stds += [exact.grip_torque_std, np.sqrt(friction_use(fingers[0].field)[1])]
    np.testing.assert_allclose(np.std(found, axis=0), stds, rtol=STD_TOLERANCE)


@pytest.mark.parametrize(
    ("pressure", "radius"),
    [(lambda r: 1.0 + 0 * r, 2 / 3), (lambda r: np.sqrt(1 - r**2), 3 * np.pi / 16)],
)
def test_the_radius_of_torsion_is_that_of_flat_and_round_contacts(pressure, radius):
    with np.errstate(invalid="ignore"):
        given = disc(0.003, 201, lambda r: np.nan_to_num(pressure(r)))
    assert torsion_radius(made_field(201, 201, **given)) == pytest.approx(0.003 * radius, rel=5e-3)
    assert np.isnan(torsion_radius(made_field(3, 3)))


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_a_torque_about_the_normal_uses_friction_as_on_an_ellipse(share):
    """At Coulomb's limit of a patch: all of it by force, by torque, or by both."""
    friction, normal = 0.7, 3.0
    field = made_field(61, 61, **disc(0.003), centre_of_pressure=np.zeros(3))
    force = share * friction * normal
    torque = np.sqrt(1 - share**2) * friction * normal * torsion_radius(field)
    given = replace(
        field,
        wrench=np.array([0.6 * force, 0.8 * force, -normal, 0, 0, torque]),
        wrench_covariance=np.zeros((6, 6)),
    )
    assert friction_use(given)[0] == pytest.approx(friction)


def test_the_margin_takes_what_slid_then_what_is_given_then_nothing():
    fingers = grip(turning=0.0)
    used = np.hypot(0.1, 0.7) / 3.0
    estimator = GraspEstimator()
    unknown = estimator.update(*fingers, 0, UP)
    assert np.isnan(unknown.slip_margin)
    assert unknown.flags == GraspFlag.FRICTION_UNKNOWN
    ratio_std = np.sqrt(friction_use(fingers[0].field)[1])
    assert unknown.friction_shown == pytest.approx(used - 2 * ratio_std, rel=0.05)
    given = estimator.update(*fingers, 1, UP, 0.5)
    assert given.slip_margin == pytest.approx(1 - used / 0.5)
    # It held more than this.
    shown = unknown.friction_shown
    assert estimator.update(*fingers, 1, UP, 0.1).slip_margin == pytest.approx(1 - used / shown)
    slides = SlipEstimate(SlipState.INCIPIENT, 0.3, used, 0.4, 0.05)
    left, right = fingers
    sliding = replace(left, field=replace(left.field, slip=slides))
    measured = estimator.update(sliding, right, 2, UP, 0.5)
    assert measured.slip_margin == pytest.approx(1 - used / 0.4)
    assert (measured.slip_state, measured.slip_ratio) == (SlipState.INCIPIENT, 0.3)
    assert measured.slip_margin_std == pytest.approx(
        np.hypot(ratio_std / 0.4, used * 0.05 / 0.4**2), rel=0.05
    )
    # What slid is known until a finger has let go.
    assert estimator.update(*fingers, 3, UP).friction_coefficient == 0.4
    gone = finger(LEFT, np.zeros(6), centre=[np.nan] * 3)
    nothing = estimator.update(gone, right, 4, UP)
    assert nothing.flags == GraspFlag.NO_CONTACT
    assert nothing.usable
    assert np.isnan(estimator.update(*fingers, 5, UP).friction_coefficient)


def weigh(estimator, loads, rate=30, up=UP, **fields):
    return [
        estimator.update(*grip(load=(0, 0, -load), **fields), round(k / rate * NS_PER_S), up)
        for k, load in enumerate(loads)
    ]


def test_the_weight_is_given_while_the_load_is_steady():
    noise = np.random.default_rng(7).normal(0, 0.03, 90)
    found = weigh(GraspEstimator(), 1.5 + noise)
    assert np.isnan(found[20].supported_weight)
    assert found[-1].supported_weight == pytest.approx(1.5, abs=4 * 0.03 / np.sqrt(30))
    up_std = np.sqrt(up_variance(LEFT) + up_variance(RIGHT))
    assert found[-1].supported_weight_std == pytest.approx(up_std)
    # While it is lifted.
    assert np.isnan(weigh(GraspEstimator(), np.linspace(0, 1.5, 60))[-1].supported_weight)
    # A large error that is the same in all frames excuses no change.
    known = {"systematic_covariance": np.eye(6), "wrench_covariance": np.eye(6) * (1 + 1e-4)}
    ramp = weigh(GraspEstimator(), np.linspace(0.9, 1.5, 60), **known)
    assert np.isnan(ramp[-1].supported_weight)


def up_variance(T):
    return UP @ T[:3, :3] @ np.diag(STD[:3] ** 2) @ T[:3, :3].T @ UP


def test_no_weight_without_a_direction_up():
    (*_, last) = weigh(GraspEstimator(), np.full(60, 1.5), up=None)
    assert np.isnan(last.supported_weight)
    assert last.flags & GraspFlag.NO_UP
    assert last.usable


def test_flags_of_both_fingers_are_joined_and_say_whether_the_state_is_usable():
    left, right = grip()
    marked = replace(left, field=replace(left.field, flags=ForceFlag.AT_BORDER))
    assert GraspEstimator().update(marked, right, 0, UP, 0.5).flags == ForceFlag.AT_BORDER
    wrong = replace(right, field=replace(right.field, flags=ForceFlag.POOR_FIT))
    state = GraspEstimator().update(marked, wrong, 0, UP, 0.5)
    assert state.flags == ForceFlag.AT_BORDER | ForceFlag.POOR_FIT
    assert not state.usable
    lost = replace(right, field=replace(right.field, wrench=np.full(6, np.nan)))
    blind = GraspEstimator().update(left, lost, 0, UP, 0.5)
    assert np.isnan([blind.grip_force, blind.slip_margin, blind.grip_torque]).all()


def test_fingers_that_look_the_same_way_are_no_grip():
    left, right = grip()
    state = GraspEstimator().update(left, replace(right, pose=left.pose), 0, UP)
    assert state.flags == GraspFlag.NOT_FACING
    assert np.isnan(state.grip_force)
    assert not state.usable
