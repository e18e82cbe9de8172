"""A reference that was taken under load is reported until one is taken of a gel that is free.

The truth of every case is hidden from the stage: it sees displacement from the reference alone.

UniversalRobots/Universal_Robots_ROS_Driver 512, zeroed at each start whatever touches: a lift-off
from it is flagged.
flexivrobotics/flexiv_tdk 31, a start in contact is meant: it is taken, and named until it is over.
DinoMini00/KineDex_code 3, readings do not return to zero: the force without contact is flagged.
sensel/sensel-api 5, the force of what stays on it decays as the baseline follows: no reference is
taken in contact, see TestKeeping.test_contact_is_no_drift_and_never_zeroed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import ForceField, ForceFlag, Surface
from cmp_tactile_processing.sensor.description import SensorDescription

from .conftest import Press

Measure = Callable[..., ForceField]
FREE = np.zeros((20, 20, 3))
DOUBTED = ForceFlag.ZERO_DOUBTFUL


@pytest.fixture(scope="module")
def stage(sensor: SensorDescription) -> ForceStage:
    """The stage of the packaged rig."""
    return ForceStage(sensor)


@pytest.fixture
def measure(stage: ForceStage, seen: Callable[..., Surface]) -> Measure:
    """Measures a true displacement against a true one that is reference `number`, with noise."""

    def process(
        moved: NDArray[np.float64], zero: NDArray[np.float64], number: int, seed: int = 1
    ) -> ForceField:
        return stage.process(seen(moved - zero, seed, zero, reference_id=number))

    process(FREE, FREE, 0)
    return process


@pytest.mark.parametrize("load", ["press", "shear", "small press", "two contacts"])
@pytest.mark.parametrize("newtons", [0.2, 2.0])
def test_lift_off_from_a_reference_under_load_is_flagged(
    measure: Measure, truth: dict[str, Press], load: str, newtons: float
) -> None:
    """As after a start with something on the gel: nothing is known from before."""
    pressed = newtons / 10 * truth[load].displacement
    assert not measure(pressed, pressed, 1).flags & DOUBTED, "that is all a reference can show"
    lifted = measure(FREE, pressed, 1)
    assert lifted.wrench[2] == pytest.approx(newtons, rel=0.2)
    assert lifted.flags & DOUBTED
    assert not measure(FREE, FREE, 2).flags & DOUBTED


@pytest.mark.parametrize(
    ("axis", "newtons", "is_doubted"),
    [(2, 0.04, False), (2, 0.06, True), (0, 0.014, False), (0, 0.03, True)],
)
def test_a_force_without_contact_is_doubted_from_a_limit_on(
    measure: Measure, truth: dict[str, Press], axis: int, newtons: float, is_doubted: bool
) -> None:
    """Ten deviations of 4 mN along z; 0.02 N along x, where a deviation is below 1 mN."""
    press, shear, small = (truth[name].displacement for name in ("press", "shear", "small press"))
    pull = -newtons / 10 * small if axis == 2 else newtons / 3 * (shear - press)
    measure(FREE, FREE, 1)
    field = measure(pull, FREE, 1)
    assert field.wrench[axis] == pytest.approx(newtons, rel=0.25)
    assert bool(field.flags & DOUBTED) == is_doubted


def test_the_load_is_stated_from_zero_to_the_next_zero_of_a_free_gel(
    stage: ForceStage, measure: Measure, truth: dict[str, Press]
) -> None:
    pressed = 0.2 * truth["press"].displacement
    measure(FREE, FREE, 1)
    assert not measure(pressed, FREE, 1).flags & DOUBTED
    for moved in (pressed, FREE, 1.5 * pressed, FREE):
        assert measure(moved, pressed, 2).flags & DOUBTED
        assert stage.zeroed_load == pytest.approx(2, rel=0.1)
    assert not measure(FREE, FREE, 3).flags & DOUBTED
    assert stage.zeroed_load == 0


def test_loads_of_two_references_add_up(
    stage: ForceStage, measure: Measure, truth: dict[str, Press]
) -> None:
    first, second = (share * truth["press"].displacement for share in (0.2, 0.35))
    measure(FREE, FREE, 1)
    measure(first, FREE, 1)
    measure(second, first, 2)
    measure(second, second, 3)
    assert stage.zeroed_load == pytest.approx(3.5, rel=0.05)


def test_a_free_gel_and_any_press_from_a_free_reference_are_not_doubted(
    measure: Measure, truth: dict[str, Press]
) -> None:
    measure(FREE, FREE, 1)
    assert not any(measure(FREE, FREE, 1, seed).flags & DOUBTED for seed in range(60))
    for name, press in truth.items():
        for newtons in (0.05, 0.2, 1.0, 5.0):
            field = measure(newtons / 10 * press.displacement, FREE, 1)
            assert not field.flags & DOUBTED, f"{name}, {newtons} N"
