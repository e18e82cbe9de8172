"""Force from displacement, against loads that were solved on another mesh."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.force.model import ForceModel, interpolation_matrix
from cmp_tactile_processing.measured import ForceFlag, SlipState, SurfaceGrid
from cmp_tactile_processing.sensor.parameters import ForceParameters
from cmp_tactile_processing.sensor.parts import MaterialRecord, PatternSurface

from .conftest import MEASURED, NOISE_M, SAGS, TRUTH_NODES, alone, errors, noisy

LOADS = ("press", "small press", "shear", "torque", "off centre", "two contacts")


@pytest.mark.parametrize("name", LOADS)
@pytest.mark.parametrize("newton", [10.0, 1.0])
def test_wrench(model, truth, name, newton):
    """1 % + 0.01 N and 0.5 N mm are asked for; noise alone gives 4 mN, 1 mN and 0.03 N mm.

    What is left at 10 N is the mesh's and the hats' share, a quarter of that.
    """
    along, across, about, over = errors(model, truth[name], newton / 10)
    assert along < 0.004 * newton + 0.008
    assert across < 0.0005 * newton + 0.004
    assert about < 2e-5 * newton + 5e-5
    assert over < 4e-5 * newton + 1e-4


def test_force_is_the_same_without_contacts(model, truth):
    moved = noisy(truth["two contacts"].displacement)
    whole = model.reconstruct(moved, MEASURED)
    found = model.reconstruct(moved, MEASURED, contacts=False)
    np.testing.assert_array_equal(found.force, whole.force)
    np.testing.assert_array_equal(found.wrench, whole.wrench)
    assert found.contact[whole.contact].all()
    assert not found.contacts
    assert np.isnan(found.wrench_covariance).all()


def ratio(field, other):
    """Largest difference of two wrenches, in their deviations."""
    std = np.minimum(field.wrench_std, other.wrench_std)
    return float((np.abs(field.wrench - other.wrench) / std).max())


def test_a_gel_unlike_its_description_owes_nothing_to_the_frames_before(model):
    """The same frame gives the same force wherever the recording begins.

    A tenth of a deviation: what the square of the last step towards the scale leaves.
    """
    first = [alone(model, moved, MEASURED) for moved in SAGS]
    assert all(field.contact.any() for field in first)
    model.reset()
    after = [model.reconstruct(moved, MEASURED) for moved in SAGS]
    assert np.max([ratio(*pair) for pair in zip(after, first, strict=True)]) < 0.1


def test_a_pixel_changes_no_force_by_more_than_its_deviation(model):
    """One corner elsewhere by its noise, in one frame: that frame and those after it."""
    random = np.random.default_rng(7)
    model.reset()
    expected = [model.reconstruct(moved, MEASURED) for moved in SAGS]
    for spoilt in range(len(SAGS)):
        moved = SAGS[spoilt].copy()
        i, j = random.integers(5, 15, 2)
        moved[i, j] += random.normal(size=3) * NOISE_M
        frames = [moved, *SAGS[spoilt + 1 :]]
        found = [model.reconstruct(frame, MEASURED) for frame in frames]
        assert np.max([ratio(*pair) for pair in zip(found, expected[spoilt:], strict=True)]) < 1.0


@pytest.mark.parametrize("name", LOADS)
def test_contact(model, truth, name):
    """Contacts are counted, the centre of pressure found, and the area roughly.

    These patches taper off so softly that the outer fifth of their area bears 2 % of the load; the
    outline is drawn at a level that suits the edge of a ball.
    """
    press = truth[name]
    field = model.reconstruct(noisy(press.displacement), MEASURED)
    radii = {"small press": [1.5e-3], "off centre": [2.5e-3], "two contacts": [1.5e-3, 1.5e-3]}
    radius = np.array(radii.get(name, [3e-3]))
    assert len(field.contacts) == len(radius)
    assert field.contact_area == pytest.approx((np.pi * radius**2).sum(), rel=0.4)
    weight = -field.force[:, 2] * field.contact
    at_rest = press.force[:, 2] @ press.position / press.force[:, 2].sum()
    assert np.linalg.norm((weight @ field.position / weight.sum() - at_rest)[:2]) < 5e-5
    # Seen along z: in a hole as deep as it is wide, depth hangs on the last detail of pressure.
    # The contact surface is dragged 0.3 mm further than the markers that the truth goes by.
    assert np.linalg.norm((field.centre_of_pressure - press.centre)[:2]) < 4e-4
    assert field.slip_state is SlipState.UNKNOWN
    assert field.valid_fraction == 1
    assert not field.flags & ~ForceFlag.LARGE_PRESS
    assert field.noise_scale == pytest.approx(1, abs=0.6)
    # Beside the contacts the solution swings around zero, which belongs to none of them.
    total = sum(contact.wrench for contact in field.contacts)
    np.testing.assert_allclose(total, field.wrench, atol=0.01 * abs(field.wrench[2]))
    for contact in field.contacts:
        std = contact.covariance[2, 2] ** 0.5
        assert contact.wrench[2] == pytest.approx(press.wrench()[2] / len(radius), abs=4 * std)


@pytest.mark.parametrize("newton", [10.0, 1.0, 0.3])
def test_error_bars_are_honest(model, truth, newton):
    """Mean of squared errors in units of the deviations given, over loads, draws and components.

    1 is right.  Mesh and hats are taken for noise, which is more than they do to the resultant.
    """
    scale, squares = newton / 10, []
    for name in LOADS:
        for seed in range(6):
            moved = noisy(scale * truth[name].displacement, seed)
            field = model.reconstruct(moved, MEASURED)
            error = field.wrench - truth[name].wrench(scale)
            squares.append((error / field.wrench_std) ** 2)
    assert 0.05 < np.mean(squares) < 2.5
    assert np.mean(squares, axis=0).max() < 5


def test_the_scatter_of_a_light_press_is_its_deviation(model, truth):
    """Of 0.1 N, which mesh and hats hardly change; 40 draws show a deviation to 11 %."""
    moved = 0.01 * truth["press"].displacement
    fields = [model.reconstruct(noisy(moved, seed), MEASURED) for seed in range(40)]
    of_contact = [field.contacts[0] for field in fields]
    for wrenches, covariances in (
        ([f.wrench for f in fields], [f.wrench_covariance for f in fields]),
        ([c.wrench for c in of_contact], [c.covariance for c in of_contact]),
    ):
        ratio = np.std(wrenches, axis=0) / np.sqrt(np.diag(np.mean(covariances, axis=0)))
        assert ((ratio > 0.65) & (ratio < 1.5)).all()


@pytest.mark.parametrize(
    ("newton", "in_plane", "along_z"),
    [(0.1, (0.35, 0.9), (0.65, 1.5)), (10, (0.25, 0.55), (0.25, 0.5))],
)
def test_deviations_of_nodes_are_those_of_their_errors(model, truth, newton, in_plane, along_z):
    """In contact.  Resolution, which a draw of noise does not show, adds to x and y, and what hats
    leave open, which these soft patches do not show, to 10 N.
    """
    fine = SurfaceGrid(TRUTH_NODES, TRUTH_NODES, model.elastic.nodes.extent)
    to_nodes = interpolation_matrix(model.elastic.nodes, fine).T
    ratios = []
    for name, seed in itertools.product(LOADS, range(4)):
        field = model.reconstruct(noisy(newton / 10 * truth[name].displacement, seed), MEASURED)
        error = field.force - newton / 10 * (to_nodes @ truth[name].force)
        ratios.append((error / field.force_std)[field.contact])
    x, y, z = np.sqrt(np.mean(np.square(np.concatenate(ratios)), axis=0))
    assert in_plane[0] < min(x, y) <= max(x, y) < in_plane[1]
    assert along_z[0] < z < along_z[1]


@pytest.mark.parametrize(("deviations", "found"), [(0.7, False), (1.8, True)])
def test_rest_says_what_force_it_may_hide(model, truth, deviations, found):
    std = model.reconstruct(noisy(np.zeros((20, 20, 3))), MEASURED).wrench_std[2]
    for name in ("press", "small press"):
        moved = deviations * std / 10 * truth[name].displacement
        for seed in range(10):
            assert bool(model.reconstruct(noisy(moved, seed), MEASURED).wrench[2]) == found


def test_an_error_of_the_model_has_four_parts(sensor, truth, cache_dir):
    """In closed form: shares of normal and tangential forces, of all together in any direction at
    their centre, and of the gel's height as the place at which they act.
    """
    error, moved, covariances = 0.02, 0.05 * truth["off centre"].displacement, []
    for share in (0.0, error):
        rig = replace(sensor, force=replace(sensor.force, model_error=share))
        field = ForceModel(rig, cache_dir).reconstruct(moved, MEASURED)
        (contact,) = field.contacts
        covariances.append([field.wrench_covariance, contact.covariance])

    def wrench(force):
        return np.concatenate([force.sum(axis=0), np.cross(field.position, force).sum(axis=0)])

    sizes = np.linalg.norm(field.force, axis=1)
    centre = sizes @ field.position / sizes.sum()
    at_centre = np.stack([np.concatenate([axis, np.cross(centre, axis)]) for axis in np.eye(3)])
    tangential, normal = wrench(field.force * [1, 1, 0]), wrench(field.force * [0, 0, 1])
    whole, across = np.linalg.norm(field.wrench[:3]), np.linalg.norm(field.wrench[:2])
    parts = np.vstack(
        [
            tangential,
            normal,
            0.2 * sizes.sum() * at_centre,
            np.diag([0, 0, 0, whole, whole, across]) * sensor.elastomer.size[2],
        ]
    )
    expected = error**2 * parts.T @ parts
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    for none, some in zip(*covariances, strict=True):
        np.testing.assert_allclose((some - none) / scale, expected / scale, atol=0.02)


def test_rest_shows_nothing(model):
    """Noise alone, 200 frames: no force at all, and the deviation given is what noise would do."""
    for seed in range(200):
        field = model.reconstruct(noisy(np.zeros((20, 20, 3)), seed), MEASURED)
        assert not field.contact.any()
        assert field.contacts == ()
        assert field.slip_state is SlipState.NO_CONTACT
        assert field.contact_area == 0
        assert np.isnan(field.centre_of_pressure).all()
        np.testing.assert_array_equal(field.force, 0)
        np.testing.assert_array_equal(field.wrench, 0)
        assert field.noise_scale == pytest.approx(1, abs=0.15)
        assert 1e-3 < field.wrench_std[2] < 0.05


# The gel is linear: loads at other places add up.  Shares of the loads of 10 N, and the places of
# what presses.
COMBINED = {
    "strong pull": ({"press": -0.5}, None),
    "small pull": ({"small press": -0.03}, None),
    "pull beside a press": ({"small press": 0.2, "off centre": -0.05}, (-1e-3, 1.5e-3)),
    "drag": ({"shear": 0.3, "press": -0.3}, None),
    "twist beside a press": ({"off centre": 0.1, "torque": 0.6, "press": -0.6}, (3e-3, -2e-3)),
}


@pytest.mark.parametrize("name", COMBINED)
def test_pulls_and_drags_are_measured_and_no_contacts(model, truth, name):
    """1 % of the force and 0.01 N, which is twice what noise and mesh leave of a press."""
    shares, place = COMBINED[name]
    moved = sum(share * truth[load].displacement for load, share in shares.items())
    force = sum(share * truth[load].force.sum(axis=0) for load, share in shares.items())
    for seed in range(3):
        field = alone(model, noisy(moved, seed), MEASURED)
        np.testing.assert_allclose(
            field.wrench[:3], force, rtol=0, atol=0.01 * np.linalg.norm(force) + 0.01
        )
        assert not field.flags & ~ForceFlag.LARGE_PRESS
        assert len(field.contacts) == (place is not None)
        assert field.contact.any() == (place is not None)
        if place is None:
            assert field.slip_state is SlipState.NO_CONTACT
            assert np.isnan(field.centre_of_pressure).all()
        else:
            # The twist drags the surface by 0.3 mm; the middle of both loads is 2.6 mm away.
            assert np.linalg.norm(field.centre_of_pressure[:2] - place) < 4e-4


def test_grid_that_is_not_square(other_rig, cache_dir):
    """Rows along y and columns along x must not be mixed up anywhere on the way."""
    surface = PatternSurface("cylinder", 0.02, "y")
    rig = other_rig(13, 19, surface)
    # So close that the force nodes are at the markers.
    rig = replace(rig, pattern=replace(rig.pattern, pitch=6e-4))
    model = ForceModel(rig, cache_dir)
    nodes = model.elastic.nodes.points
    weights = np.maximum(0, 1 - ((nodes - [2e-3, -1e-3]) ** 2).sum(axis=1) / 3e-3**2) ** 1.5
    force = (weights / weights.sum())[:, None] * [0.1, -0.2, -0.8]
    field = model.reconstruct(model.elastic.displacement(force), np.ones((13, 19), dtype=np.uint8))
    assert (field.rows, field.cols) == (13, 19)
    np.testing.assert_allclose(field.wrench[:3], [0.1, -0.2, -0.8], atol=0.005)
    place = field.position + model.elastic.displacement(force).reshape(-1, 3)
    expected = force[:, 2] @ place / force[:, 2].sum()
    assert np.linalg.norm((field.centre_of_pressure - expected)[:2]) < 5e-5
    height = surface.height(nodes) + rig.elastomer.shading_layer.thickness
    np.testing.assert_allclose(field.position[:, 2], height)


@pytest.mark.parametrize(
    ("pattern", "radius", "share"), [((9, 2), 1.6e-3, 0.01), ((4, 6), 3e-3, 0.03)]
)
def test_a_small_contact_on_a_coarse_pattern(other_rig, cache_dir, pattern, radius, share):
    """1 % is asked for where two markers lie across the contact, of 4 x 4 corners 3 %.

    With force nodes at the corners alone, the first weighed 3 % too much, the second nothing.
    """
    corners, step = pattern
    every = step * (corners - 1) + 1
    rig = other_rig(every, every, PatternSurface())
    fine = ElasticProblem.from_sensor(rig)
    away = ((fine.nodes.points - 0.8e-3) ** 2).sum(axis=1) / radius**2
    weights = np.maximum(0, 1 - away) ** 0.5
    force = (weights / weights.sum())[:, None] * [0.0, 0.0, -3.0]
    moved = fine.expand(fine.solve(force.reshape(-1, 1)), of_nodes=False) / rig.elastomer.young
    moved = moved.reshape(every, every, 3)[::step, ::step]
    coarse = ForceModel(other_rig(corners, corners, PatternSurface()), cache_dir)
    field = coarse.reconstruct(moved, np.ones((corners, corners), dtype=np.uint8))
    assert field.wrench[2] == pytest.approx(-3.0, rel=share)


def test_parameters_reach_the_field(sensor, truth, cache_dir):
    """A fixed weight of the first pass alone: less force; a floor above the peak: no contact."""
    parameters = ForceParameters(regularization=0.1, two_pass=False, contact_pressure_floor=1e9)
    stiff = ForceModel(replace(sensor, force=parameters), cache_dir)
    field = stiff.reconstruct(truth["press"].displacement, MEASURED)
    assert field.regularization == pytest.approx(0.1, rel=0.2)
    assert -9.5 < field.wrench[2] < -5
    assert not field.contact.any()
    assert (field.young, field.poisson) == (sensor.elastomer.young, 0.48)


def test_uncertain_material_widens_the_error_bars(sensor, model, truth, cache_dir):
    """Relative deviations of a calibration come on top, along their own components."""
    record = MaterialRecord("weights", "2026-07-01T12:00:00Z", 4, 0.05, 0.1)
    elastomer = replace(sensor.elastomer, calibration=record)
    uncertain = ForceModel(replace(sensor, elastomer=elastomer), cache_dir)
    moved = noisy(truth["shear"].displacement)
    known, field = (alone(item, moved, MEASURED) for item in (model, uncertain))
    np.testing.assert_array_equal(field.wrench, known.wrench)
    expected = np.hypot(known.wrench_std[:3], np.abs(field.wrench[:3]) * [0.1, 0.1, 0.05])
    np.testing.assert_allclose(field.wrench_std[:3], expected, rtol=1e-2)


def test_a_deep_press_of_a_linear_gel_is_flagged(sensor, model, truth):
    """No rubber is linear at 16 % of the thickness, whatever its description says."""
    press = truth["press"].displacement / -truth["press"].displacement[..., 2].min()
    thickness = sensor.elastomer.size[2]
    sure, deep = (
        alone(model, noisy(share * thickness * press), MEASURED) for share in (0.14, 0.16)
    )
    assert sure.flags == ForceFlag.NONE
    assert deep.flags == ForceFlag.LARGE_PRESS
    assert deep.wrench[2] == pytest.approx(16 / 14 * sure.wrench[2], rel=0.01)


@pytest.fixture
def uncorrected(sensor):
    """A neo-Hookean gel without the correction for large presses."""
    gel = replace(sensor.elastomer, model="neo_hookean")
    return replace(sensor, elastomer=gel, force=ForceParameters(large_press="off"))


@pytest.mark.parametrize(("share", "is_large"), [(0.02, False), (0.027, True)])
def test_a_neo_hookean_gel_is_linear_up_to_a_share(uncorrected, truth, cache_dir, share, is_large):
    press = truth["press"].displacement / -truth["press"].displacement[..., 2].min()
    moved = share * uncorrected.elastomer.size[2] * press
    flags = ForceModel(uncorrected, cache_dir).reconstruct(noisy(moved), MEASURED).flags
    assert flags == (ForceFlag.LARGE_PRESS if is_large else ForceFlag.NONE)


def test_large_press_that_is_not_corrected_is_in_doubt(
    sensor, uncorrected, model, truth, cache_dir
):
    """Half of depth over thickness, and a flag."""
    moved = noisy(0.2 * truth["press"].displacement)
    sure = alone(model, moved, MEASURED)
    field = ForceModel(uncorrected, cache_dir).reconstruct(moved, MEASURED)
    assert field.flags == ForceFlag.LARGE_PRESS
    np.testing.assert_array_equal(field.wrench, sure.wrench)
    depth = -moved[..., 2].min() / sensor.elastomer.size[2]
    expected = np.hypot(sure.wrench_std[2], 0.5 * depth * field.wrench[2])
    assert field.wrench_std[2] == pytest.approx(expected, rel=0.05)
    total = field.contacts[0].covariance[2, 2] ** 0.5
    assert total == pytest.approx(field.wrench_std[2], rel=0.05)
