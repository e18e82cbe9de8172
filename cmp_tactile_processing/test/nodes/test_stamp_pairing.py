"""Two topics are paired by equal stamp, whatever is lost, late or out of order."""

from __future__ import annotations

import numpy as np
import pytest

from cmp_tactile_processing.nodes.stereo_triangulator import StampPairing


@pytest.fixture
def pairing() -> StampPairing:
    return StampPairing(("left", "right"), capacity=4)


def test_the_oldest_is_given_up_when_a_side_stays_away(pairing):
    for stamp in range(100):
        assert pairing.add("left", stamp, stamp) is None
    assert pairing.unpaired == {"left": 96, "right": 0}
    assert pairing.add("right", 95, "r") is None
    assert pairing.add("right", 96, "r") == (96, "r")


def test_repeated_stamp_keeps_the_newer(pairing):
    pairing.add("left", 1, "old")
    pairing.add("left", 1, "new")
    assert pairing.unpaired["left"] == 1
    assert pairing.add("right", 1, "r") == ("new", "r")


def test_shuffled_within_the_buffer_loses_nothing():
    pairing = StampPairing(("left", "right"), capacity=10)
    rng = np.random.default_rng(5)
    arrivals = [
        (stamp + rng.uniform(0, 4), side, stamp)
        for stamp in range(200)
        for side in ("left", "right")
    ]
    pairs = [pairing.add(side, stamp, stamp) for _, side, stamp in sorted(arrivals)]
    assert sorted(pair for pair in pairs if pair) == [(stamp, stamp) for stamp in range(200)]
    assert pairing.unpaired == {"left": 0, "right": 0}
