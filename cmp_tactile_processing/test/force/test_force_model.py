"""Force from displacement, against loads that were solved on another mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.errors import GeometryError
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.plausibility import Plausibility
from cmp_tactile_processing.measured.force_field import ForceFlag, SlipState
from cmp_tactile_processing.measured.surface_grid import SurfaceGrid
from cmp_tactile_processing.sensor.parameters import ForceParameters
from cmp_tactile_processing.sensor.parts import MaterialRecord, PatternSurface

LOADS = ("press", "small press", "shear", "torque", "off centre", "two contacts")
NOISE_M = np.array([2e-6, 2e-6, 5e-6])
MEASURED = np.ones((20, 20), dtype=np.uint8)


def noisy(displacement, seed=0):
    return displacement + np.random.default_rng(seed).normal(size=displacement.shape) * NOISE_M


def alone(model, *frame):
    """The field of a frame that comes first."""
    model.reset()
    return model.reconstruct(*frame)


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
    """1 % + 0.01 N and 0.5 N mm are asked for; noise alone gives 4 mN, 1 mN and 0.03 N mm.

    What is left at 10 N is the mesh's and the hats' share, a quarter of that.
    """
    along, across, about, over = errors(model, truth[name], newton / 10)
    assert along < 0.004 * newton + 0.008
    assert across < 0.0005 * newton + 0.004
    assert about < 2e-5 * newton + 5e-5
    assert over < 4e-5 * newton + 1e-4


def test_a_frame_owes_little_to_the_ones_before(model, truth):
    """Scales that settled in other frames, even of another load, change nothing that counts.

    1e-3 of the force: a sixth of what noise and mesh leave of 10 N.
    """
    moved = noisy(truth["press"].displacement)
    first = alone(model, moved, MEASURED)
    model.reconstruct(noisy(0.1 * truth["two contacts"].displacement, 1), MEASURED)
    after = model.reconstruct(moved, MEASURED)
    again = model.reconstruct(moved, MEASURED)
    for field in (after, again):
        np.testing.assert_allclose(field.wrench[:3], first.wrench[:3], atol=1e-2)
        np.testing.assert_allclose(field.wrench[3:], first.wrench[3:], atol=2e-5)
    np.testing.assert_array_equal(alone(model, moved, MEASURED).force, first.force)


def sag(deep_m, drag_m=0.0):
    """A smooth hollow made by hand, which no elastic gel shows: (20, 20, 3) m."""
    x, y = np.meshgrid(*2 * [(np.arange(20) - 9.5) * 0.0145 / 21])
    shape = np.exp(-(x**2 + y**2) / (2 * 2e-3**2))
    return shape[..., None] * [drag_m, 0.0, -deep_m]


def ratio(field, other):
    """Largest difference of two wrenches, in their deviations."""
    std = np.minimum(field.wrench_std, other.wrench_std)
    return float((np.abs(field.wrench - other.wrench) / std).max())


SAGS = [
    noisy(sag(deep, drag), seed)
    for seed, (deep, drag) in enumerate([(3e-4, 0), (5e-4, 0), (8e-4, 0), (8e-4, 3e-4)])
]


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


def test_a_frame_that_fails_leaves_nothing_to_the_next(model, truth, monkeypatch):
    """Scales from which no solution came would fail in the next frame, and in all after it."""
    moved = noisy(truth["press"].displacement)
    first = alone(model, moved, MEASURED)

    def fails(*_):
        msg = "matrix: found one that is not definite"
        raise GeometryError(msg)

    with monkeypatch.context() as patch:
        patch.setattr("cmp_tactile_processing.force.contact_traction.factor", fails)
        with pytest.raises(GeometryError):
            model.reconstruct(moved, MEASURED)
    np.testing.assert_array_equal(model.reconstruct(moved, MEASURED).force, first.force)


@pytest.mark.parametrize("name", LOADS)
def test_contact(model, truth, name):
    """Contacts are counted, the centre of pressure found, and the area told within a third.

    These patches taper off so softly that where they end is a matter of the level.
    """
    press = truth[name]
    field = model.reconstruct(noisy(press.displacement), MEASURED)
    radii = {"small press": [1.5e-3], "off centre": [2.5e-3], "two contacts": [1.5e-3, 1.5e-3]}
    radius = np.array(radii.get(name, [3e-3]))
    assert len(field.contacts) == len(radius)
    assert field.contact_area == pytest.approx((np.pi * radius**2).sum(), rel=1 / 3)
    weight = -field.force[:, 2] * field.contact
    at_rest = press.force[:, 2] @ press.position / press.force[:, 2].sum()
    assert np.linalg.norm((weight @ field.position / weight.sum() - at_rest)[:2]) < 5e-5
    # Seen along z: in a hole as deep as it is wide, depth hangs on the last detail of pressure.
    # The contact surface is dragged 0.3 mm further than the markers that the truth goes by.
    assert np.linalg.norm((field.centre_of_pressure - press.centre)[:2]) < 4e-4
    assert field.slip_state is SlipState.UNKNOWN
    assert field.valid_fraction == 1
    assert field.flags == ForceFlag.NONE
    assert field.noise_scale == pytest.approx(1, abs=0.6)


def test_contacts_make_up_the_wrench(model, truth):
    press = truth["two contacts"]
    field = model.reconstruct(noisy(press.displacement), MEASURED)
    total = sum(contact.wrench for contact in field.contacts)
    # Beside the contacts the solution swings around zero, which belongs to none of them.
    np.testing.assert_allclose(total, field.wrench, atol=0.01 * abs(field.wrench[2]))
    half = press.wrench()[2] / 2
    for contact in field.contacts:
        assert contact.wrench[2] == pytest.approx(half, abs=4 * contact.covariance[2, 2] ** 0.5)


@pytest.mark.parametrize(("newton", "bound"), [(10.0, 0.05), (1.0, 0.15)])
@pytest.mark.parametrize("name", LOADS)
def test_distribution(model, truth, name, newton, bound):
    """Consistent nodal forces, relative: the bounds that are asked for at these loads."""
    press, scale = truth[name], newton / 10
    found = model.reconstruct(noisy(scale * press.displacement), MEASURED).force
    expected = scale * collected(model.elastic.nodes, press)
    assert np.linalg.norm(found - expected) < bound * np.linalg.norm(expected)


def collected(nodes, press):
    """The true forces as the hats of the nodes collect them: force and centre are kept."""
    lines = []
    for axis, line in ((1, nodes.y), (0, nodes.x)):
        away = np.abs(press.position[:, axis, None] - line) / (line[1] - line[0])
        lines.append(np.maximum(0, 1 - away))
    shares = np.einsum("ni,nj->nij", *lines).reshape(len(press.position), -1)
    return shares.T @ press.force


@pytest.mark.parametrize("newton", [10.0, 1.0, 0.3])
def test_error_bars_are_honest(model, truth, newton):
    """Mean of squared errors in units of the deviations told, over loads, draws and components.

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


def test_error_bars_hold_what_leaks_into_other_directions(model, truth):
    """Near the border 0.06 % of a press is taken for a force along the surface."""
    field = alone(model, noisy(0.5 * truth["press"].displacement), MEASURED)
    assert (field.wrench_std[:2] > 5e-4 * 5.0).all()
    # Bars that hold everything would say nothing.
    assert (field.wrench_std[:2] < 1e-3 * 5.0).all()
    assert field.contacts[0].covariance[0, 0] == pytest.approx(field.wrench_std[0] ** 2, rel=0.1)


def test_a_press_points_into_the_gel(model, truth):
    """Sign convention: force on the gel, z outwards; the wrench is about the gel's origin."""
    field = model.reconstruct(truth["shear"].displacement, MEASURED)
    assert truth["shear"].displacement[10, 10, 2] < 0
    assert field.wrench[2] < 0
    assert field.wrench[0] > 0
    np.testing.assert_allclose(field.wrench[:3], field.force.sum(axis=0))
    moved = model.elastic.node_displacement(field.force)
    moment = np.cross(field.position + moved, field.force).sum(axis=0)
    np.testing.assert_allclose(field.wrench[3:], moment, atol=1e-3)
    np.testing.assert_array_equal(field.reference_point, np.zeros(3))


def test_rest_shows_nothing(model):
    """Noise alone, 200 frames: no force at all, and the deviation told is what noise would do."""
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


def test_lightest_touch(model, truth):
    """0.05 N on 3 mm radius is felt in every frame, with an error that the deviation covers."""
    press = truth["press"]
    errors_ = []
    for seed in range(10):
        field = model.reconstruct(noisy(5e-3 * press.displacement, seed), MEASURED)
        assert len(field.contacts) == 1
        errors_.append((field.wrench[2] + 0.05) / field.wrench_std[2])
    assert np.sqrt(np.mean(np.square(errors_))) < 2.5


# The gel is linear: loads at other places add up.  Shares of the loads of 10 N, and the places of
# what presses.
COMBINED = {
    "pull": ({"press": -0.1}, None),
    "strong pull": ({"press": -0.5}, None),
    "small pull": ({"small press": -0.03}, None),
    "pull beside a press": ({"small press": 0.2, "off centre": -0.05}, (-1e-3, 1.5e-3)),
    "weak pull beside a press": ({"small press": 0.5, "off centre": -0.02}, (-1e-3, 1.5e-3)),
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
        assert field.flags == ForceFlag.NONE
        assert len(field.contacts) == (place is not None)
        assert field.contact.any() == (place is not None)
        if place is None:
            assert field.slip_state is SlipState.NO_CONTACT
            assert np.isnan(field.centre_of_pressure).all()
        else:
            # The twist drags the surface by 0.3 mm; the middle of both loads is 2.6 mm away.
            assert np.linalg.norm(field.centre_of_pressure[:2] - place) < 4e-4


def test_large_deviations_leave_a_marker_out(model, truth):
    """A marker that is told to be a hundred times less certain may stand where it likes."""
    press = truth["shear"]
    spoilt = noisy(press.displacement)
    covariance = np.tile(np.diag(NOISE_M**2), (20, 20, 1, 1))
    right = alone(model, spoilt, MEASURED, covariance)
    spoilt[8, 9] += [1e-3, 0, 1e-3]
    covariance[8, 9] *= 1e4
    field = model.reconstruct(spoilt, MEASURED, covariance)
    np.testing.assert_allclose(field.wrench[:3], right.wrench[:3], atol=0.03)
    for useless in (np.nan, 0.0):
        told = np.full((20, 20, 3, 3), useless)
        same = alone(model, noisy(press.displacement), MEASURED, told)
        np.testing.assert_array_equal(same.force, right.force)


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
    expected = alone(model, moved, status).force
    for rubbish in (np.nan, np.inf, 0.0, 1e6):
        spoilt = np.where((status == 0)[..., None], rubbish, moved)
        np.testing.assert_array_equal(alone(model, spoilt, status).force, expected)


def test_component_that_is_not_finite_counts_as_missing_whatever_its_status(model, truth):
    """Per component: a monocular sensor knows x and y alone, and the tangential force with them."""
    press = truth["shear"]
    moved = press.displacement.copy()
    moved[3, 4] = np.nan
    status = MEASURED.copy()
    status[3, 4] = 0
    np.testing.assert_allclose(
        alone(model, moved, MEASURED).force, alone(model, moved, status).force, rtol=1e-9
    )
    flat = noisy(press.displacement)
    flat[..., 2] = np.nan
    field = model.reconstruct(flat, MEASURED)
    assert field.valid_fraction == 1
    np.testing.assert_allclose(field.wrench[:2], press.wrench()[:2], atol=0.02)
    assert field.wrench[2] == pytest.approx(-10, abs=4)


@pytest.mark.parametrize("far_m", [1.0, 1e300])
def test_marker_farther_off_than_the_gel_is_large_counts_as_missing(model, truth, far_m):
    """Numbers that no gel can show, and that would overflow, are no force and no "no contact"."""
    moved = noisy(truth["press"].displacement)
    expected = alone(model, moved, np.where(np.arange(400) == 63, 0, 1).reshape(20, 20))
    moved[3, 3, 1] = far_m
    np.testing.assert_array_equal(alone(model, moved, MEASURED).wrench, expected.wrench)
    field = model.reconstruct(np.full((20, 20, 3), -far_m), MEASURED)
    assert field.flags == ForceFlag.FEW_MARKERS
    assert np.isnan(field.wrench).all()


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


def misnumbered(moved, model, part=np.s_[:], columns=1):
    """Markers of a part (rows, cols) taken for those so many columns before them."""
    markers = model.elastic.markers
    place = markers.points.reshape(20, 20, 2)
    height = PatternSurface("sphere_cap", 0.027).height(place)
    rest = np.concatenate([place, height[..., None]], axis=-1)
    wrong = np.full_like(moved, np.nan)
    wrong[:, :-columns] = (rest + moved)[:, columns:] - rest[:, :-columns]
    found = moved.copy()
    found[part] = wrong[part]
    return found


PARTS = {
    "all": np.s_[:],
    "half of the rows": np.s_[:10],
    "half of the columns": np.s_[:, 10:],
    "a few columns": np.s_[:, :3],
    "a row": np.s_[7],
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("load", ["none", "press", "off centre"])
def test_numbering_that_is_off_by_a_column_gives_no_force(model, truth, part, load):
    moved = np.zeros((20, 20, 3)) if load == "none" else 0.3 * truth[load].displacement
    wrong = misnumbered(noisy(moved), model, PARTS[part])
    field = model.reconstruct(wrong, np.isfinite(wrong).all(axis=-1).astype(np.uint8))
    assert field.flags == ForceFlag.IMPLAUSIBLE
    assert np.isnan(field.wrench).all()
    assert np.isnan(field.wrench_covariance).all()
    assert np.isnan(field.force).all()
    assert not field.contact.any()
    assert field.contacts == ()
    assert field.slip_state is SlipState.UNKNOWN
    after = model.reconstruct(truth["press"].displacement, MEASURED)
    assert after.wrench[2] == pytest.approx(-10, abs=0.1)


ABSURD = {
    "pulled out of its base": lambda moved: -4 * moved,
    "raised by a misnumbered view": lambda moved: moved + [0.0, 0.0, 2e-3],
    "pressed on all over": lambda moved: moved - [0.0, 0.0, 4e-3],
    "deeper than the gel": lambda moved: 4 * moved,
    "farther aside than the gel gives": lambda moved: moved + [0.013, 0.0, 0.0],
    "shuffled": lambda moved: (
        np.random.default_rng(1).permutation(moved.reshape(-1, 3)).reshape(moved.shape)
    ),
    "a marker that is another": lambda moved: (
        moved + ((np.arange(400) == 130).reshape(20, 20, 1) * [7e-4, 0.0, 0.0])
    ),
}


@pytest.mark.parametrize("absurd", ABSURD)
def test_what_no_gel_shows_gives_no_force(model, truth, absurd):
    field = model.reconstruct(ABSURD[absurd](truth["press"].displacement), MEASURED)
    assert field.flags == ForceFlag.IMPLAUSIBLE
    assert np.isnan(field.wrench).all()


def test_what_a_gel_shows_is_plausible(model, truth):
    """Presses, drags, twists and pulls up to 10 N, and hand-made hollows."""
    cases = [scale * press.displacement for press in truth.values() for scale in (0.02, 0.3, 1.0)]
    cases += [-truth["press"].displacement, *SAGS]
    for moved in cases:
        field = model.reconstruct(moved, MEASURED)
        assert ForceFlag.IMPLAUSIBLE not in field.flags
        assert np.isfinite(field.wrench).all()


def test_a_neo_hookean_gel_is_not_pressed_deeper_than_to_its_base(sample_rig):
    """A linear one gives way without end, so that its limit is farther."""
    for name, farthest in (("linear", 11.9e-3), ("neo_hookean", 5.9e-3)):
        rig = replace(sample_rig, elastomer=replace(sample_rig.elastomer, model=name))
        plausibility = Plausibility(rig, SurfaceGrid(20, 20, 2 * (19 * rig.pattern.pitch,)))
        hollow = sag(1.0)
        assert plausibility.allows_displacement(farthest * hollow)
        assert not plausibility.allows_displacement(1.05 * farthest * hollow)


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
def test_grid_that_is_not_square(other_rig, built_plane, cache_dir, surface):
    """Rows along y and columns along x must not be mixed up anywhere on the way."""
    rig = other_rig(8, 13, surface)
    model = ForceModel(rig, built_plane.folder if surface.type == "plane" else cache_dir)
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


def test_parameters_reach_the_field(sample_rig, truth, cache_dir):
    """A fixed weight of the first pass alone: less force; a floor above the peak: no contact."""
    parameters = ForceParameters(regularization=0.1, two_pass=False, contact_pressure_floor=1e9)
    stiff = ForceModel(replace(sample_rig, force=parameters), cache_dir)
    field = stiff.reconstruct(truth["press"].displacement, MEASURED)
    assert field.regularization == pytest.approx(0.1, rel=0.2)
    assert -9.5 < field.wrench[2] < -5
    assert not field.contact.any()
    assert (field.young, field.poisson) == (sample_rig.elastomer.young, 0.48)


def test_uncertain_material_widens_the_error_bars(sample_rig, model, truth, cache_dir):
    """Relative deviations of a calibration come on top, along their own components."""
    record = MaterialRecord("weights", "2026-07-01T12:00:00Z", 4, 0.05, 0.1)
    elastomer = replace(sample_rig.elastomer, calibration=record)
    uncertain = ForceModel(replace(sample_rig, elastomer=elastomer), cache_dir)
    moved = noisy(truth["shear"].displacement)
    known, field = (alone(item, moved, MEASURED) for item in (model, uncertain))
    np.testing.assert_array_equal(field.wrench, known.wrench)
    expected = np.hypot(known.wrench_std[:3], np.abs(field.wrench[:3]) * [0.1, 0.1, 0.05])
    np.testing.assert_allclose(field.wrench_std[:3], expected, rtol=1e-2)


def test_large_press_that_is_not_corrected_is_in_doubt(sample_rig, model, truth, cache_dir):
    """A neo-Hookean gel without the correction: half of depth over thickness, and a flag."""
    neo = replace(
        sample_rig,
        elastomer=replace(sample_rig.elastomer, model="neo_hookean"),
        force=ForceParameters(large_press="off"),
    )
    moved = noisy(0.2 * truth["press"].displacement)
    sure = alone(model, moved, MEASURED)
    field = ForceModel(neo, cache_dir).reconstruct(moved, MEASURED)
    assert field.flags == ForceFlag.LARGE_PRESS
    np.testing.assert_array_equal(field.wrench, sure.wrench)
    depth = -moved[..., 2].min() / sample_rig.elastomer.size[2]
    expected = np.hypot(sure.wrench_std[2], 0.5 * depth * field.wrench[2])
    assert field.wrench_std[2] == pytest.approx(expected, rel=0.05)
    total = field.contacts[0].covariance[2, 2] ** 0.5
    assert total == pytest.approx(field.wrench_std[2], rel=0.05)
