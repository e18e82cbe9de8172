"""Error bars of forces that change while the rows of a frame are read out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_forces import made_contact, made_field

from cmp_tactile_processing.force.error_bars import RollingShutter
from cmp_tactile_processing.measured import ForceField

# Of the readout, and between two frames.
READOUT_S, INTERVAL_S = 0.02, 1 / 30
# At the second frame, N/s and N m/s, of a force that speeds up evenly from rest.
RATE = np.array([0.5, -1.0, 6.0, 0.01, 0.02, 0.03])
DRAWS = 20_000


def _at(seconds: float) -> ForceField:
    """Without noise, on one node."""
    force, wrench = np.zeros((4, 3)), RATE * seconds**2 / (2 * INTERVAL_S)
    force[1] = wrench[:3]
    return replace(
        made_field(2, 2),
        force=force,
        force_std=np.zeros_like(force),
        wrench=wrench,
        wrench_covariance=np.zeros((6, 6)),
        systematic_covariance=np.zeros((6, 6)),
        contacts=(made_contact([1], covariance=np.zeros((6, 6))),),
    )


def _second(readout_time: float, interval_ns: int = round(INTERVAL_S * 1e9)) -> ForceField:
    shutter = RollingShutter(readout_time)
    shutter.add(_at(0.0), 0)
    return shutter.add(_at(INTERVAL_S), interval_ns)


def test_error_bars_are_those_of_rows_at_any_time_of_the_readout() -> None:
    times = np.random.default_rng(3).uniform(-READOUT_S / 2, READOUT_S / 2, DRAWS)
    # A variance from so many draws, four times its deviation.
    tolerance = 4 * np.sqrt(2 / DRAWS)
    drawn = np.cov((times[:, None] * RATE).T)
    found = _second(READOUT_S)
    for covariance in (
        found.wrench_covariance,
        found.systematic_covariance,
        found.contacts[0].covariance,
    ):
        np.testing.assert_allclose(covariance, drawn, rtol=tolerance)
    assert found.force_std is not None
    np.testing.assert_allclose(found.force_std[1], found.wrench_std[:3])
    np.testing.assert_array_equal(found.force_std[[0, 2, 3]], 0.0)


@pytest.mark.parametrize(("readout", "interval_ns"), [(0.0, 33_000_000), (READOUT_S, 0)])
def test_nothing_is_added_without_readout_or_time(readout: float, interval_ns: int) -> None:
    np.testing.assert_array_equal(_second(readout, interval_ns).wrench_std, 0.0)


def test_a_force_that_stays_has_the_error_bar_of_its_pixels() -> None:
    shutter = RollingShutter(READOUT_S)
    shutter.add(_at(1.0), 0)
    np.testing.assert_array_equal(shutter.add(_at(1.0), 33_000_000).wrench_std, 0.0)


def test_a_frame_without_force_is_not_compared_with() -> None:
    shutter = RollingShutter(READOUT_S)
    shutter.add(_at(1.0), 0)
    shutter.add(replace(_at(1.0), wrench=np.full(6, np.nan)), 33_000_000)
    np.testing.assert_array_equal(shutter.add(_at(2.0), 66_000_000).wrench_std, 0.0)
