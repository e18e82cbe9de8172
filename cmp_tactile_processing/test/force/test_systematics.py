"""Errors that all forces share, against forces that were changed by drawn errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.force.systematics import (
    BY_PATTERN,
    BY_SKIN,
    SystematicErrors,
    by_poisson,
    by_thickness,
)
from cmp_tactile_processing.measured import (
    Contact,
    ForceField,
    ForceFlag,
    ReferenceFault,
    SlipEstimate,
    Systematics,
)
from cmp_tactile_processing.sensor.description import SensorDescription
from cmp_tactile_processing.sensor.parts import MaterialRecord, Uncertainty
from cmp_tactile_processing.surface.displacement import Reference, surface_at_rest

DRAWS = 20_000
# Of a standard deviation from so many draws, four times over.
MONTE_CARLO = 4 / np.sqrt(2 * DRAWS)
Share = Callable[[SensorDescription], float]
EXACT = dict.fromkeys(("young", "poisson", "thickness", "shading_layer"), 0.0)


def _exact(sensor: SensorDescription, **std: float) -> SensorDescription:
    """A gel that is known exactly, but for some deviations."""
    named = {f"elastomer.{name}": value for name, value in (EXACT | std).items()}
    return replace(sensor, uncertainty=Uncertainty(named))


def _field(sensor: SensorDescription) -> ForceField:
    """Some forces on a few nodes, known without noise."""
    random = np.random.default_rng(2)
    position = random.uniform(-5e-3, 5e-3, (30, 3)) * [1, 1, 0.05] + [2e-3, 0, 0]
    force = random.normal(0, 0.1, (30, 3)) + [0.05, -0.02, -0.2]
    stage = ForceStage(sensor)
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    empty = stage.process(surface)
    wrench = np.concatenate([force.sum(axis=0), np.cross(position, force).sum(axis=0)])
    return replace(
        empty,
        position=position,
        force=force,
        force_std=np.zeros_like(force),
        wrench=wrench,
        wrench_covariance=np.zeros((6, 6)),
        contacts=(),
    )


def test_moments_follow_their_forces(sensor: SensorDescription) -> None:
    # All forces larger by a share: so are all moments.
    share = 0.07
    field = _field(sensor)
    found = SystematicErrors(_exact(sensor, young=share)).add(field, None)
    np.testing.assert_allclose(found.systematic_std, share * np.abs(field.wrench), rtol=1e-6)
    np.testing.assert_allclose(found.force_std, share * np.abs(field.force), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "of_tangential", "of_normal"),
    [
        ("thickness", by_thickness, by_thickness),
        ("shading_layer", lambda _: BY_SKIN, lambda _: BY_SKIN),
        ("poisson", lambda _: 0.0, by_poisson),
    ],
)
def test_each_uncertainty_of_the_gel_counts_by_how_forces_follow_it(
    sensor: SensorDescription, name: str, of_tangential: Share, of_normal: Share
) -> None:
    field = _field(sensor)
    found = SystematicErrors(_exact(sensor, **{name: 0.05})).add(field, None)
    across, along = of_tangential(sensor), of_normal(sensor)
    shares = 0.05 * np.abs([across, across, along])
    np.testing.assert_allclose(found.systematic_std[:3], shares * np.abs(field.wrench[:3]))


def test_a_calibrated_gel_has_the_deviations_of_its_record(sensor: SensorDescription) -> None:
    record = MaterialRecord("weights", "2026-07-01T12:00:00Z", 5, 0.02, 0.04)
    known = replace(sensor, elastomer=replace(sensor.elastomer, calibration=record))
    field = _field(sensor)
    found = SystematicErrors(known).add(field, None)
    expected = np.array([0.04, 0.04, 0.02]) * np.abs(field.wrench[:3])
    np.testing.assert_allclose(found.systematic_std[:3], expected, rtol=1e-9)


def test_a_wrench_off_the_origin_turns_with_its_force(sensor: SensorDescription) -> None:
    """J C J^T, J by differences: one force, whose place grows with the pattern."""
    place, force = np.array([[3e-3, -5e-3, 2e-3]]), np.array([[0.4, -0.7, -3.0]])
    root = np.random.default_rng(3).normal(0, 0.01, (11, 11))
    seen = Systematics(0.4 * root @ root.T, 0.6 * root @ root.T)

    def wrench(error: NDArray[np.float64]) -> NDArray[np.float64]:
        size = BY_PATTERN * error[9] + by_thickness(sensor) * error[10]
        moved = force[0] + error[:9].reshape(3, 3) @ force[0] + size * force[0]
        return np.concatenate([moved, np.cross((1 + error[9]) * place[0], moved)])

    jacobian = np.stack([(wrench(s) - wrench(-s)) / 2e-4 for s in 1e-4 * np.eye(11)], axis=1)
    field = replace(_field(sensor), position=place, force=force, force_std=0 * force)
    one = Contact(
        np.array([0]), wrench(np.zeros(11)), np.zeros((6, 6)), 0.0, place[0], place, False
    )
    found = SystematicErrors(_exact(sensor)).add(replace(field, contacts=(one,)), seen)
    expected = jacobian @ seen.total @ jacobian.T
    np.testing.assert_allclose(found.systematic_covariance, expected, rtol=1e-6, atol=1e-15)
    np.testing.assert_array_equal(found.wrench_covariance, found.systematic_covariance)
    np.testing.assert_allclose(found.random_std, 0.0, atol=1e-9)
    np.testing.assert_array_equal(found.contacts[0].covariance, found.systematic_covariance)
    np.testing.assert_allclose(found.force_std[0], np.sqrt(np.diag(expected)[:3]), rtol=1e-9)


def test_friction_has_the_errors_that_its_forces_do_not_share(sensor: SensorDescription) -> None:
    """Monte Carlo: tangential over normal force, each with a gain, and a modulus for both."""
    random = np.random.default_rng(5)
    total = np.zeros((11, 11))
    total[np.ix_((0, 8), (0, 8))] = total[np.ix_((4, 8), (4, 8))] = [[9e-4, 2e-4], [2e-4, 4e-4]]
    slip = SlipEstimate(friction_coefficient=0.6, friction_std=0.01)
    field = replace(_field(sensor), slip=slip)
    sensor = _exact(sensor, young=0.1)
    found = SystematicErrors(sensor).add(field, Systematics(total, 0 * total)).slip
    along, normal = random.multivariate_normal([1, 1], total[np.ix_((0, 8), (0, 8))], DRAWS).T
    drawn = np.hypot(0.01, np.std(0.6 * along / normal))
    assert found.friction_std == pytest.approx(drawn, rel=MONTE_CARLO)


@pytest.mark.parametrize("is_open", [True, False])
def test_what_weights_have_measured_is_open_no_more(
    sensor: SensorDescription, is_open: bool
) -> None:
    """What optics leave open of the force has been weighed; what has changed since counts."""
    moments = np.zeros((11, 11))
    moments[8, 8] = 0.1**2
    seen = Systematics(0 * moments, moments) if is_open else Systematics(moments, 0 * moments)
    record = MaterialRecord("weights", "2026-07-01T12:00:00Z", 5, 0.02, 0.02)
    known = replace(sensor, elastomer=replace(sensor.elastomer, calibration=record))
    field = _field(sensor)
    found = SystematicErrors(known).add(field, seen).systematic_std[2]
    expected = 0.02 if is_open else np.hypot(0.02, 0.1)
    assert found == pytest.approx(expected * abs(field.wrench[2]), rel=1e-9)


@pytest.mark.parametrize(
    ("std", "flag"), [(0.13, ForceFlag.NONE), (0.17, ForceFlag.SCALE_UNCERTAIN)]
)
def test_newtons_by_an_assumed_modulus_are_flagged(
    sensor: SensorDescription, std: float, flag: ForceFlag
) -> None:
    stage = ForceStage(_exact(sensor, young=std))
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    assert stage.process(surface).flags & ForceFlag.SCALE_UNCERTAIN == flag


@pytest.mark.parametrize(("of_bias", "flag"), [(True, False), (False, True)])
def test_what_rest_leaves_open_of_the_scale_is_flagged_and_what_it_shows_is_not(
    sensor: SensorDescription, of_bias: bool, flag: bool
) -> None:
    moments = np.zeros((11, 11))
    moments[8, 8] = 0.2**2
    parts = (moments, 0 * moments) if of_bias else (0 * moments, moments)
    errors = SystematicErrors(_exact(sensor))
    errors.add(_field(sensor), Systematics(*parts))
    assert errors.scale_is_uncertain == flag


def test_lengths_in_another_unit_make_the_scale_uncertain(sensor: SensorDescription) -> None:
    elastomer = replace(sensor.elastomer, size=tuple(100 * side for side in sensor.elastomer.size))
    assert not SystematicErrors(_exact(sensor)).scale_is_uncertain
    assert SystematicErrors(_exact(replace(sensor, elastomer=elastomer))).scale_is_uncertain


@pytest.mark.parametrize(
    ("faults", "flag"),
    [
        (ReferenceFault.NONE, ForceFlag.NONE),
        (ReferenceFault.TOUCHED, ForceFlag.ZERO_DOUBTFUL),
        (ReferenceFault.DESCRIPTION, ForceFlag.DESCRIPTION_DOUBTFUL),
    ],
)
def test_faults_of_the_reference_flag_each_force(
    sensor: SensorDescription, faults: ReferenceFault, flag: ForceFlag
) -> None:
    surface = surface_at_rest(Reference.nominal(sensor), sensor.pattern.shape)
    field = ForceStage(sensor).process(replace(surface, reference_faults=faults))
    doubted = ForceFlag.ZERO_DOUBTFUL | ForceFlag.DESCRIPTION_DOUBTFUL
    assert field.flags & doubted == flag
