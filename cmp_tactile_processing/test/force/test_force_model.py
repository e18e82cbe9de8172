"""Force from displacement, against loads that were solved on another mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force import ForceModel
from cmp_tactile_processing.force_field import SlipState
from cmp_tactile_processing.parameters import ForceParameters
from cmp_tactile_processing.pattern import PatternSurface

LOADS = ("press", "small press", "shear", "torque", "off centre", "two contacts")
NOISE_M = np.array([2e-6, 2e-6, 5e-6])
MEASURED = np.ones((20, 20), dtype=np.uint8)


def noisy(displacement, seed=0):
    return displacement + np.random.default_rng(seed).normal(size=displacement.shape) * NOISE_M


def errors(model, press, scale=1.0, status=MEASURED):
    """Root mean square over four draws of noise: along z and across, N; about z and across, N m."""
    squares = []
    for seed in range(4):
        field = model.reconstruct(noisy(scale * press.displacement, seed), status)
        wrong = (field.wrench - press.wrench(scale)) ** 2
        squares.append([wrong[2], wrong[:2].sum(), wrong[5], wrong[3:5].sum()])
    return np.sqrt(np.mean(squares, axis=0))


@pytest.mark.parametrize("name", LOADS)
@pytest.mark.parametrize("newton", [10.0, 1.0])
def test_wrench(model, truth, name, newton):
    """Share of the load: what mesh and regularisation cost; constant: four draws of the noise.

    The noise alone gives 0.018 N along z, 2 mN across, 5e-6 N m about z and 8e-5 across.  How far
    the load moves, and with it the moment of its parts, grows with its square.
    """
    along, across, about, over = errors(model, truth[name], newton / 10)
    assert along < 0.005 * newton + 0.04
    assert across < 0.0005 * newton + 0.004
    assert about < 1e-6 * newton**2 + 1e-5
    assert over < 1e-5 * newton + 1.5e-4


@pytest.mark.parametrize("name", LOADS)
def test_contact(model, truth, name):
    """The area where the pressure is above 8 % of its peak, and the centre of pressure."""
    press = truth[name]
    field = model.reconstruct(noisy(press.displacement), MEASURED)
    radii = {"small press": [1.5e-3], "off centre": [2.5e-3], "two contacts": [1.5e-3, 1.5e-3]}
    # (1 - (r / R)^2)^1.5 = 0.08 at r^2 = 0.814 R^2; half a node is gained all around.
    radius = np.array(radii.get(name, [3e-3])) * np.sqrt(0.814) + 0.345e-3
    assert field.contact_area == pytest.approx((np.pi * radius**2).sum(), rel=0.2)
    # Seen along z: in a hole as deep as it is wide, depth hangs on the last detail of pressure.
    assert np.linalg.norm((field.centre_of_pressure - press.centre)[:2]) < 1e-4
    assert field.slip_state is SlipState.UNKNOWN
    assert field.valid_fraction == 1


def test_distribution(model):
    """Relative error of the nodal forces of a patch of 4 mm, at 10 N and at 1 N."""
    distance2 = (model.elastic.nodes.points**2).sum(axis=1) / 4e-3**2
    weights = np.maximum(0, 1 - distance2) ** 1.5
    force = (weights / weights.sum())[:, None] * [2.0, 1.0, -10.0]
    moved = model.elastic.displacement(force)
    for scale, bound in ((1.0, 0.06), (0.1, 0.2)):
        found = model.reconstruct(noisy(scale * moved), MEASURED).force
        assert np.linalg.norm(found - scale * force) < bound * np.linalg.norm(scale * force)


def test_a_press_points_into_the_gel(model, truth):
    """Sign convention: force on the gel, z outwards; the wrench is about the gel's origin."""
    field = model.reconstruct(truth["shear"].displacement, MEASURED)
    assert truth["shear"].displacement[10, 10, 2] < 0
    assert field.wrench[2] < 0
    assert field.wrench[0] > 0
    np.testing.assert_allclose(field.wrench[:3], field.force.sum(axis=0))
    moved = model.elastic.displacement(field.force).reshape(-1, 3)
    moment = np.cross(field.position + moved, field.force).sum(axis=0)
    np.testing.assert_allclose(field.wrench[3:], moment)
    np.testing.assert_array_equal(field.reference_point, np.zeros(3))


def test_rest_shows_no_contact(model):
    """Noise alone, 100 frames of 400 nodes: none above five standard deviations."""
    for seed in range(100):
        field = model.reconstruct(noisy(np.zeros((20, 20, 3)), seed), MEASURED)
        assert not field.contact.any()
        assert field.slip_state is SlipState.NO_CONTACT
        assert field.contact_area == 0
        assert np.isnan(field.centre_of_pressure).all()
        assert abs(field.wrench[2]) < 0.1


def test_pull_is_no_contact(model, truth):
    field = model.reconstruct(-truth["press"].displacement, MEASURED)
    assert field.wrench[2] > 9
    assert not field.contact[np.argmax(field.force[:, 2])]


HIDDEN = {
    "random tenth": np.random.default_rng(11).random((20, 20)) < 0.1,
    "random third": np.random.default_rng(12).random((20, 20)) < 1 / 3,
    "third on the right": np.broadcast_to(np.arange(20) > 12, (20, 20)),
    "third at the top": np.broadcast_to(np.arange(20)[:, None] > 12, (20, 20)),
}


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("name", ["press", "shear", "torque"])
def test_hidden_markers(model, truth, name, hidden):
    """A third hidden in one piece reaches into the contact and costs most, 0.5 N of 10 N.

    Hidden markers that counted as not displaced would cost 3 N.
    """
    status = (~HIDDEN[hidden]).astype(np.uint8)
    along, across, _, _ = errors(model, truth[name], status=status)
    in_one_piece = hidden.startswith("third")
    assert along < (0.8 if in_one_piece else 0.12)
    assert across < (0.5 if in_one_piece else 0.02)
    field = model.reconstruct(truth[name].displacement, status)
    assert field.valid_fraction == pytest.approx(1 - HIDDEN[hidden].mean())


def test_hidden_contact_gives_an_answer(model, truth):
    """Far from good, the contact being half hidden, but a number and nothing raised."""
    for side in (slice(0, 7), slice(13, 20)):
        status = MEASURED.copy()
        status[side] = 0
        for press in truth.values():
            assert np.isfinite(model.reconstruct(press.displacement, status).wrench).all()


def test_what_a_missing_marker_holds_does_not_matter(model, truth):
    moved = truth["shear"].displacement
    status = (~HIDDEN["random tenth"]).astype(np.uint8)
    expected = model.reconstruct(moved, status).force
    for rubbish in (np.nan, np.inf, 0.0, 1e6):
        spoilt = np.where((status == 0)[..., None], rubbish, moved)
        np.testing.assert_array_equal(model.reconstruct(spoilt, status).force, expected)


def test_component_that_is_not_finite_counts_as_missing_whatever_its_status(model, truth):
    """Per component: a monocular sensor knows x and y alone, and the tangential force with them."""
    press = truth["shear"]
    moved = press.displacement.copy()
    moved[3, 4] = np.nan
    status = MEASURED.copy()
    status[3, 4] = 0
    np.testing.assert_allclose(
        model.reconstruct(moved, MEASURED).force, model.reconstruct(moved, status).force, rtol=1e-9
    )
    flat = noisy(press.displacement)
    flat[..., 2] = np.nan
    field = model.reconstruct(flat, MEASURED)
    assert field.valid_fraction == 1
    np.testing.assert_allclose(field.wrench[:2], press.wrench()[:2], atol=0.02)
    assert field.wrench[2] == pytest.approx(-10, abs=4)


@pytest.mark.parametrize("seen", [0, 119])
def test_too_few_markers_give_nan(model, truth, seen):
    status = np.zeros(400, dtype=np.uint8)
    status[:seen] = 1
    field = model.reconstruct(truth["press"].displacement, status.reshape(20, 20))
    assert np.isnan(field.force).all()
    assert np.isnan(field.wrench).all()
    assert np.isnan(field.contact_area)
    assert not field.contact.any()
    assert field.slip_state is SlipState.UNKNOWN
    assert field.valid_fraction == seen / 400


@pytest.mark.parametrize(
    ("displacement", "status", "message"),
    [
        ((20, 19, 3), (20, 20), r"displacement: found shape \(20, 19, 3\), expected \(20, 20, 3\)"),
        ((20, 20, 2), (20, 20), r"displacement: found shape \(20, 20, 2\), expected \(20, 20, 3\)"),
        ((20, 20, 3), (400,), r"status: found shape \(400,\), expected \(20, 20\)"),
    ],
)
def test_wrong_shapes(model, displacement, status, message):
    with pytest.raises(GeometryError, match=f"sample_rig: {message}"):
        model.reconstruct(np.zeros(displacement), np.ones(status, dtype=np.uint8))


@pytest.mark.parametrize(
    "surface", [PatternSurface(), PatternSurface("cylinder", 0.02, "y")], ids=["plane", "cylinder"]
)
def test_grid_that_is_not_square(other_rig, tmp_path, surface):
    """Rows along y and columns along x must not be mixed up anywhere on the way."""
    rig = other_rig(8, 13, surface)
    model = ForceModel(rig, tmp_path)
    nodes = model.elastic.nodes.points
    weights = np.maximum(0, 1 - ((nodes - [2e-3, -1e-3]) ** 2).sum(axis=1) / 3e-3**2) ** 1.5
    force = (weights / weights.sum())[:, None] * [1.0, -2.0, -8.0]
    field = model.reconstruct(model.elastic.displacement(force), np.ones((8, 13), dtype=np.uint8))
    assert (field.rows, field.cols) == (8, 13)
    np.testing.assert_allclose(field.wrench[:3], [1, -2, -8], atol=0.05)
    place = field.position + model.elastic.displacement(force).reshape(-1, 3)
    expected = force[:, 2] @ place / force[:, 2].sum()
    assert np.linalg.norm((field.centre_of_pressure - expected)[:2]) < 2e-4
    height = surface.height(nodes) + rig.elastomer.shading_layer.thickness
    np.testing.assert_allclose(field.position[:, 2], height)


def test_parameters_reach_the_field(sample_rig, model, truth, cache_dir):
    """More regularisation, less force; a floor above the peak leaves no contact."""
    parameters = ForceParameters(regularization=0.2, contact_pressure_floor=1e9)
    stiff = ForceModel(replace(sample_rig, force=parameters), cache_dir)
    press = truth["press"]
    field = stiff.reconstruct(press.displacement, MEASURED)
    assert field.regularization == 0.2
    assert -field.wrench[2] < -model.reconstruct(press.displacement, MEASURED).wrench[2] - 0.5
    assert not field.contact.any()
    assert (field.young, field.poisson) == (sample_rig.elastomer.young, 0.48)
