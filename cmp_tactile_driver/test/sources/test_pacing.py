"""Events keep their intervals; lateness moves the rest instead of bunching it."""

from __future__ import annotations

import pytest

from cmp_tactile_driver.sources.capture import CATCH_UP, Pacer


class _Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_intervals_do_not_drift():
    clock = _Clock()
    pacer = Pacer(clock)
    times = []
    for _ in range(100):
        clock.now += pacer.delay(0.05) + 0.001  # the work itself takes 1 ms
        times.append(clock.now)
    assert times[-1] - times[0] == pytest.approx(99 * 0.05, abs=1e-9)


def test_late_event_moves_the_rest():
    clock = _Clock()
    pacer = Pacer(clock)
    pacer.delay(0.05)
    clock.now += 1.0  # a stall of 20 intervals
    assert pacer.delay(0.05) == 0.0
    assert pacer.delay(0.05) >= 0.05 - CATCH_UP
    assert pacer.max_lateness == pytest.approx(0.95)


def test_restart_is_due_at_once():
    clock = _Clock()
    pacer = Pacer(clock)
    pacer.delay(0.05)
    pacer.restart()
    assert pacer.delay(10.0) == 0.0
    assert pacer.max_lateness == 0.0
