"""Frames with markers missing or misplaced, and frames that no gel can show."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.errors import InputError
from cmp_tactile_processing.force.plausibility import Plausibility
from cmp_tactile_processing.measured import ForceFlag, SlipState
from cmp_tactile_processing.sensor.parts import PatternSurface

from .conftest import MEASURED, SAGS, alone, noisy


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


@pytest.mark.parametrize(
    ("newton", "allowed"), [(16.0, True), (19.0, False), (-130.0, True), (-145.0, False)]
)
def test_force_is_limited_by_suction_and_by_a_press_all_through(sensor, model, newton, allowed):
    """1 bar on (13.1 mm)^2 are 17.4 N; Gent: E (1 + 2 s^2) there are 138 N, s = 13.1 mm / 4 h."""
    plausibility = Plausibility(sensor, model.elastic.markers)
    force = np.zeros((400, 3))
    force[:, 2] = newton / 400
    assert plausibility.allows_force(force, np.zeros((20, 20, 3))) == allowed


def test_what_a_gel_shows_is_plausible(model, truth):
    """Presses, drags, twists and pulls up to 10 N, and hand-made hollows."""
    cases = [scale * press.displacement for press in truth.values() for scale in (0.02, 0.3, 1.0)]
    cases += [-truth["press"].displacement, *SAGS]
    for moved in cases:
        field = model.reconstruct(moved, MEASURED)
        assert ForceFlag.IMPLAUSIBLE not in field.flags
        assert np.isfinite(field.wrench).all()


@pytest.mark.parametrize(
    ("displacement", "status", "message"),
    [
        ((20, 19, 3), (20, 20), r"displacement: found shape \(20, 19, 3\), expected \(20, 20, 3\)"),
        ((20, 20, 2), (20, 20), r"displacement: found shape \(20, 20, 2\), expected \(20, 20, 3\)"),
        ((20, 20, 3), (400,), r"status: found shape \(400,\), expected \(20, 20\)"),
    ],
)
def test_wrong_shapes(model, displacement, status, message):
    with pytest.raises(InputError, match=f"sample_rig: {message}"):
        model.reconstruct(np.zeros(displacement), np.ones(status, dtype=np.uint8))
