"""Error bars of forces where displacements count from the description."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cmp_tactile_processing.force.stage import ForceStage
from cmp_tactile_processing.measured import ReferenceFault
from cmp_tactile_processing.surface.stillness import RestParameters

# By so much a gel may be off its description, and looks as described.
OFF_M = RestParameters().rest_tolerance / 2
PLACES = np.moveaxis(np.indices((20, 20)) - 9.5, 0, -1) / 9.5
WAYS = {
    "along x": [OFF_M, 0, 0],
    "along y": [0, -OFF_M, 0],
    "into the gel": [0, 0, -OFF_M],
    "out of it": [0, 0, OFF_M],
}


def tilted() -> dict[str, np.ndarray]:
    """Fields (20, 20, 3) m of a gel that lies elsewhere, is tilted, or bent."""
    found = {name: np.broadcast_to(np.array(way, float), (20, 20, 3)) for name, way in WAYS.items()}
    row, col = PLACES[..., 0], PLACES[..., 1]
    for name, height in {"tilted": col, "bent": 1 - row**2 - col**2}.items():
        found[name] = OFF_M * height[..., None] * np.array([0, 0, 1.0])
    return found


@pytest.fixture(scope="module")
def stage(sensor):
    return ForceStage(sensor)


@pytest.mark.parametrize("name", [*WAYS, "tilted", "bent"])
def test_a_gel_that_is_not_quite_as_described_is_in_the_error_bar(stage, seen, name):
    surface = seen(tilted()[name])
    assert surface.reference_faults & ReferenceFault.NOT_TAKEN
    field = stage.process(surface)
    # Nothing presses: all of it is an error.
    assert (np.abs(field.wrench) < 4 * field.wrench_std).all()


def test_a_reference_takes_this_error_away(stage, seen, truth):
    surface = seen(0.2 * truth["press"].displacement)
    before = stage.process(surface)
    after = stage.process(replace(surface, reference_id=1, reference_faults=ReferenceFault.NONE))
    np.testing.assert_array_equal(after.wrench, before.wrench)
    more = before.wrench_covariance - after.wrench_covariance
    # Of the sample's gel: a bonded block, 14 x 14 x 6 mm of 500 kPa, that is compressed by 12 um.
    assert np.sqrt(more[2, 2]) == pytest.approx(0.30, rel=0.1)
    assert np.sqrt(more[0, 0]) == pytest.approx(0.062, rel=0.1)
    assert (before.force_std > after.force_std).all()
    contacts = (field.contacts[0].covariance.diagonal() for field in (before, after))
    assert np.greater(*contacts).all()
