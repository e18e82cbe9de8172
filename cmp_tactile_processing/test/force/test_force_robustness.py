"""What tracking gives at its worst is reported by flags of the force stage, never by a crash."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.elastic.mesh import MeshDensity
from cmp_tactile_processing.elastic.model import ElasticProblem
from cmp_tactile_processing.force.model import ForceModel
from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import (
    ForceField,
    ForceFlag,
    SlipState,
    Status,
    Surface,
    SurfaceGrid,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import GelRelaxation

from .conftest import NOISE_M, Press, bump, noisy

# Of the 10 N of the loads that are taken for true: 1 N presses the gel in by about 0.3 mm.
SCALE = 0.1
# The mesh of these loads is another one, too.
WIDE_DENSITY = MeshDensity(across=18, rim=2, depth=3, layer=1, growth=1.3)
# Centre and radius in mm of patches on a gel whose markers end at 6.56 mm.
WIDE_LOADS = {
    "inside": ((3.0, -2.0), 2.5),
    "at border": ((-1.0, 5.7), 0.9),
    "across border": ((6.6, 0.5), 2.0),
    "beside border": ((8.0, 1.0), 1.2),
    "farther off": ((8.3, 1.0), 1.7),
    "outside a corner": ((-7.6, 7.4), 1.5),
}
OUTSIDE = [name for name in WIDE_LOADS if name not in ("inside", "at border")]


@pytest.fixture(scope="module")
def stage(sensor: SensorDescription) -> ForceStage:
    """The stage of the packaged rig, from the user's cache."""
    return ForceStage(sensor)


@pytest.fixture(scope="module")
def wide(sensor: SensorDescription) -> dict[str, NDArray[np.float64]]:
    """Displacement (rows, cols, 3) m under 1 N anywhere on the gel, by name of the load."""
    problem = ElasticProblem.from_sensor(sensor)
    grid = SurfaceGrid(61, 61, (0.02, 0.02))
    problem = replace(problem, nodes=grid, density=WIDE_DENSITY)
    force = np.array([0.15, -0.1, -1.0])
    columns = [
        (bump(grid.points, (1e-3 * x, 1e-3 * y), 1e-3 * radius)[:, None] * force).ravel()
        for (x, y), radius in WIDE_LOADS.values()
    ]
    moved = problem.expand(problem.solve(np.stack(columns, axis=1)), of_nodes=False)
    moved = (moved / sensor.elastomer.young).T.reshape(len(columns), *_shape(sensor), 3)
    return dict(zip(WIDE_LOADS, moved, strict=True))


def _shape(sensor: SensorDescription) -> tuple[int, int]:
    return sensor.pattern.rows, sensor.pattern.cols


def hidden(surface: Surface, where: NDArray[np.bool_]) -> Surface:
    """The surface with some markers (rows, cols) missing."""
    moved, place = surface.displacement.copy(), surface.position.copy()
    status = surface.status.copy()
    moved[where], place[where], status[where] = np.nan, np.nan, Status.MISSING
    return replace(surface, displacement=moved, position=place, status=status)


def alone(stage: ForceStage, surface: Surface) -> ForceField:
    """The force field of a surface without any before it."""
    stage.reset()
    return stage.process(surface)


def assert_near(field: ForceField, press: Press, share: float) -> None:
    """Resultant force within a share of its size, and within 4 of its own deviations beyond."""
    truth = press.wrench(SCALE)[:3]
    error = np.abs(field.wrench[:3] - truth)
    assert (error < share * np.linalg.norm(truth) + 0.01).all(), error
    assert (error < 4 * field.wrench_std[:3] + 0.01 * np.linalg.norm(truth)).all(), error


SCATTERED = np.random.default_rng(5).random((20, 20)) < 0.2
LEFT = np.broadcast_to(np.arange(20) < 9, (20, 20))


@pytest.mark.parametrize(
    ("name", "hides"),
    [
        ("press", (SCATTERED, 0.03)),
        ("shear", (SCATTERED, 0.03)),
        ("off centre", (SCATTERED, 0.03)),
        # The contact is at x = 3 mm; a finger hides all on the left.
        ("off centre", (LEFT, 0.05)),
    ],
    ids=["press", "shear", "off centre", "half hidden"],
)
def test_missing_corners_cost_little_and_raise_no_flag(stage, seen, truth, name, hides):
    where, share = hides
    field = alone(stage, hidden(seen(SCALE * truth[name].displacement), where))
    assert_near(field, truth[name], share)
    assert field.valid_fraction == pytest.approx(1 - where.mean())
    assert not field.flags & (ForceFlag.POOR_FIT | ForceFlag.BEYOND_MARKERS)


def test_a_contact_that_leaves_the_view_of_a_larger_pattern_is_at_its_border(sensor, seen, truth):
    beyond = replace(sensor, pattern=replace(sensor.pattern, border="beyond_view"))
    larger = ForceStage(beyond)
    moved = SCALE * truth["off centre"].displacement
    # The contact is at x = 3 mm, and the view ends within it.
    out_of_view = np.broadcast_to(np.arange(20) >= 14, (20, 20))
    field = alone(larger, hidden(seen(moved), out_of_view))
    assert field.flags & ForceFlag.AT_BORDER
    assert not alone(larger, seen(moved)).flags & ForceFlag.AT_BORDER


def test_a_hidden_contact_is_reported_and_its_deviation_is_honest(stage, seen, truth):
    press = truth["press"]
    where = np.zeros((20, 20), np.bool_)
    where[6:14, 6:14] = True
    whole = alone(stage, seen(SCALE * press.displacement))
    field = alone(stage, hidden(seen(SCALE * press.displacement), where))
    assert ForceFlag.HIDDEN_CONTACT not in whole.flags
    assert ForceFlag.HIDDEN_CONTACT in field.flags
    error = np.abs(field.wrench[:3] - press.wrench(SCALE)[:3])
    assert (error < 3 * field.wrench_std[:3]).all(), (error, field.wrench_std[:3])


@pytest.mark.parametrize(("share", "is_hidden"), [(0.13, False), (0.3, True)])
def test_a_share_of_a_contact_may_be_hidden(stage, seen, truth, share, is_hidden):
    moved = SCALE * truth["press"].displacement
    i, j = np.indices((20, 20)) - 9.5
    where = (np.hypot(i, j) < 5) & (np.random.default_rng(1).random((20, 20)) < share)
    field = alone(stage, hidden(seen(moved), where))
    assert (ForceFlag.HIDDEN_CONTACT in field.flags) == is_hidden


@pytest.mark.parametrize(("rows", "flags"), [(5, ForceFlag.FEW_MARKERS), (6, ForceFlag.NONE)])
def test_a_force_needs_three_tenths_of_the_markers(stage, seen, rows, flags):
    where = np.arange(20)[:, None] + np.zeros((20, 20)) >= rows
    assert alone(stage, hidden(seen(np.zeros((20, 20, 3))), where)).flags == flags


def test_fewer_markers_average_less_noise(stage, seen):
    rest = seen(np.zeros((20, 20, 3)))
    half = np.indices((20, 20)).sum(axis=0) % 2 == 0
    whole, fewer = (alone(stage, surface) for surface in (rest, hidden(rest, half)))
    ratio = fewer.random_std / whole.random_std * whole.noise_scale / fewer.noise_scale
    np.testing.assert_allclose(ratio, np.sqrt(2), rtol=1e-6)


@pytest.mark.parametrize(
    ("left", "is_poor"),
    [((2.5, 1.0), False), ((3.5, 1.0), True), ((8.0, 0.14), False), ((8.0, 0.28), True)],
)
def test_motion_that_no_force_explains_is_a_poor_fit(stage, seen, truth, left, is_poor):
    """More than three times the usual noise, and a fifth of all motion beside a press."""
    noise, share = left
    press = truth["press"].displacement
    in_noise = np.sqrt(np.mean((press / NOISE_M) ** 2))
    scale = noise * np.sqrt(1 / share**2 - 1) / in_noise
    moved = scale * press + noisy(0 * press, 3) * np.sqrt(noise**2 - 1)
    surface = seen(moved)
    assert (ForceFlag.POOR_FIT in alone(stage, surface).flags) == is_poor
    # Markers that are said to be so noisy, as those of a dark or blurred picture are.
    allowed = replace(surface, covariance=noise**2 * surface.covariance)
    assert ForceFlag.POOR_FIT not in alone(stage, allowed).flags


def test_lost_frames_are_nan_and_leave_nothing_behind(stage, seen, truth):
    press = seen(SCALE * truth["press"].displacement)
    before = alone(stage, press)
    few = np.ones((20, 20), np.bool_)
    few[:2] = False
    for where in (np.ones((20, 20), np.bool_), few):
        lost = stage.process(hidden(press, where))
        assert lost.flags == ForceFlag.FEW_MARKERS
        assert np.isnan(lost.wrench).all()
        assert np.isnan(lost.wrench_std).all()
        assert not lost.contact.any()
        assert lost.slip_state is SlipState.UNKNOWN
    after = stage.process(press)
    np.testing.assert_allclose(after.wrench, before.wrench, rtol=1e-9)
    assert after.slip_state is not SlipState.NO_CONTACT


@pytest.mark.parametrize("newton", [1.0, -1.0, 4.0])
def test_loads_outside_the_markers_are_flagged(stage, seen, wide, newton):
    """Presses and pulls of which 40 to 100 % act outside, in frames of usual noise."""
    for name in OUTSIDE:
        flags = alone(stage, seen(newton * wide[name])).flags
        assert ForceFlag.BEYOND_MARKERS in flags, name
        # Something is taken for a force at the edge.
        assert ForceFlag.AT_BORDER in flags, name


@pytest.mark.parametrize("name", ["inside", "at border"])
def test_loads_on_the_markers_are_not_taken_for_loads_outside(stage, seen, wide, name):
    for force in (-1.0, 0.5, 2.0, 8.0):
        flags = alone(stage, seen(force * wide[name])).flags
        assert ForceFlag.BEYOND_MARKERS not in flags
        assert (ForceFlag.AT_BORDER in flags) == (name == "at border")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda c: np.full_like(c, np.nan),
        np.zeros_like,
        lambda c: np.where(np.arange(20)[:, None, None, None] == 3, np.inf, c),
        lambda c: 1e12 * c,
        lambda c: -c,
    ],
    ids=["nan", "zero", "partly inf", "huge", "negative"],
)
def test_covariances_that_say_nothing_change_little(stage, seen, truth, spoil):
    press = truth["shear"]
    surface = seen(SCALE * press.displacement)
    field = alone(stage, replace(surface, covariance=spoil(surface.covariance)))
    assert_near(field, press, 0.02)
    assert np.isfinite(field.wrench_covariance).all()


def test_a_marker_known_badly_counts_if_it_has_moved_much_farther(stage, seen, truth):
    """Without it the peak of a small contact would be what its neighbours say of it."""
    surface = seen(SCALE * truth["shear"].displacement)
    motion = np.linalg.norm(surface.displacement, axis=-1)
    peak = motion >= np.sort(motion, axis=None)[-9]
    whole, without = alone(stage, surface), alone(stage, hidden(surface, peak))
    for share, expected in ((0.08, whole), (0.12, without)):
        bad = (share * motion[peak]) ** 2 / 3
        covariance = surface.covariance.copy()
        covariance[peak] = bad[:, None, None] * np.eye(3)
        found = alone(stage, replace(surface, covariance=covariance))
        np.testing.assert_allclose(found.force, expected.force, atol=1e-12)


def test_another_reference_begins_again(sensor, seen, truth):
    """What the gel remembers counts from the old reference."""
    soft = replace(sensor.elastomer, relaxation=GelRelaxation(share=0.3, time=2.0))
    stage = ForceStage(replace(sensor, elastomer=soft))
    press, rest = (seen(k * SCALE * truth["press"].displacement) for k in (1, 0))
    fields = [stage.process(surface, stamp) for surface, stamp in ((rest, 0), (press, 10**7))]
    # A frame that comes twice is no begin of another recording.
    assert stage.process(press, 10**7).wrench[2] == pytest.approx(fields[1].wrench[2])
    held = stage.process(press, 20 * 10**9)
    assert all(field.relaxed for field in fields)
    # A quick press is elastic; held, the same shape needs 0.7 of the force.
    assert held.wrench[2] == pytest.approx(0.7 * fields[1].wrench[2], rel=0.02)
    again = stage.process(replace(rest, reference_id=1), 21 * 10**9)
    assert not again.contact.any()
    back = stage.process(replace(press, reference_id=1), 1)
    assert back.relaxed
    assert not stage.process(press).relaxed


def test_a_marker_that_is_elsewhere_for_a_frame_leaves_nothing_behind(sensor, seen, truth):
    """Remembered by the relaxation, it would be a marker pulled by millimetres for seconds."""
    soft = replace(sensor.elastomer, relaxation=GelRelaxation(share=0.3, time=1.0))
    stage = ForceStage(replace(sensor, elastomer=soft))
    moved = SCALE * truth["press"].displacement
    wild = moved.copy()
    wild[4, 4] = 0.1
    frames = (0 * moved, wild, moved)
    fields = [stage.process(seen(frame), index * 10**8) for index, frame in enumerate(frames)]
    assert ForceFlag.BEYOND_MARKERS not in fields[1].flags
    wrenches = [field.wrench[:3] for field in fields[1:]]
    np.testing.assert_allclose(*wrenches, atol=0.03)
    assert ForceFlag.POOR_FIT not in fields[2].flags


@pytest.fixture(scope="module")
def one_view(sensor):
    optics = replace(sensor.optics, type="monocular")
    return ForceStage(replace(sensor, optics=optics, views={"left": sensor.views["left"]}))


def seen_aslant(moved, slant):
    """A press is a shift of the markers on the surface that they are taken to be on.

    slant: tangent of the angle between the camera's axis and the gel's.
    """
    return moved + moved[..., 2:] * np.array([0.0, slant, 0.0]) + [0.0, 0.0, np.nan]


@pytest.mark.parametrize("slant", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", ["press", "shear", "off centre"])
def test_one_view_says_how_little_it_knows(one_view, seen, truth, name, slant):
    press = truth[name]
    field = alone(one_view, seen(seen_aslant(SCALE * press.displacement, slant)))
    assert ForceFlag.NO_DEPTH in field.flags
    error = np.abs(field.wrench[:3] - press.wrench(SCALE)[:3])
    assert (error < 3 * field.wrench_std[:3]).all(), (error, field.wrench_std[:3])
    # The shares of its size that docs/results.md states.
    share = field.wrench_std[:3] / np.linalg.norm(field.wrench[:3])
    np.testing.assert_allclose(share, [0.3, 0.3, 1.0], rtol=0.1)
    # What is not known of its size does not make it no contact.
    assert field.contact.any()
    assert field.contacts
    assert field.slip_state == SlipState.UNKNOWN


@pytest.mark.parametrize(("newton", "slant"), [(0.2, 0.0), (2.0, 0.0), (2.0, 0.5), (2.0, 1.0)])
def test_one_view_shows_where_it_is_pressed(one_view, seen, truth, newton, slant):
    """The size of its force is known to 100 %, which must not hide the contact of 1.5 mm radius."""
    press = truth["small press"]
    field = alone(one_view, seen(seen_aslant(newton / 10 * press.displacement, slant)))
    (contact,) = field.contacts
    assert 0.5 < contact.area / (np.pi * 1.5e-3**2) < 2
    assert np.linalg.norm((contact.centre_of_pressure - press.centre)[:2]) < 5e-4


def test_one_view_takes_a_drag_for_no_contact(one_view, seen, truth):
    drag = truth["shear"].displacement - truth["press"].displacement
    field = alone(one_view, seen(seen_aslant(SCALE * drag, 0.5)))
    assert not field.contacts
    assert np.hypot(*field.wrench[:2]) > 0.2


def test_a_press_beyond_the_correction_is_forgotten_when_it_ends(sensor):
    """A wide press of more force, which the gel can follow, would be reported uncorrected."""
    gel = replace(sensor.elastomer, model="neo_hookean")
    model = ForceModel(replace(sensor, elastomer=gel))
    status = np.full(_shape(sensor), Status.MEASURED, np.uint8)
    place = model.elastic.nodes.points
    even = np.full(len(place), 1 / len(place))
    fields = [
        model.reconstruct(model.elastic.displacement(weight[:, None] * [0.0, 0.0, newton]), status)
        for weight, newton in ((bump(place, (0, 0), 2e-3), -8.0), (even, 0.0), (even, -20.0))
    ]
    flagged = [ForceFlag.NOT_CONVERGED in field.flags for field in fields]
    assert flagged == [True, False, False]
    assert fields[2].corrected
