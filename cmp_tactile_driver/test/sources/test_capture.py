"""Events keep their intervals, clocks their offset, and a worker the reason of its failure."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from cmp_tactile_driver.errors import FrameSourceError
from cmp_tactile_driver.sources.timing import CATCH_UP, STEP_NS, ClockOffset, Pacer
from cmp_tactile_driver.sources.worker import Worker


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


def test_stop_ends_a_wait_and_the_work_can_begin_again():
    begun = threading.Semaphore(0)
    stopped = []

    def work():
        begun.release()
        stopped.append(worker.wait(60.0))

    worker = Worker("test", work)
    for count in (1, 2):
        worker.start()
        assert begun.acquire(timeout=20)
        worker.stop()
        worker.stop()
        assert stopped == [True] * count
    assert worker.failure == ""


def test_a_worker_can_stop_itself():
    ended = threading.Event()

    def work():
        worker.stop()
        ended.set()

    worker = Worker("test", work)
    worker.start()
    assert ended.wait(20)


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        (FrameSourceError("no frames"), "no frames"),
        (ValueError("a bug"), "ValueError: a bug"),
    ],
)
def test_a_failure_is_kept(error, failure):
    def work():
        raise error

    worker = Worker("test", work)
    worker.start()
    worker.stop()
    assert worker.failure == failure


START_NS = 1_700_000_000 * 10**9


class _Clocks:
    """A monotonic clock that goes on by `tick_ns` at each reading, and one that is `ahead_ns`."""

    def __init__(self):
        self.now_ns = 10**12
        self.ahead_ns = float(START_NS)
        self.slew = 0.0
        self.ticks = iter(())

    def monotonic(self):
        step = next(self.ticks, 200)
        self.now_ns += step
        self.ahead_ns += self.slew * step
        return self.now_ns

    def other(self):
        return round(self.monotonic() + self.ahead_ns)

    def sleep(self, duration_ns):
        self.now_ns += duration_ns
        self.ahead_ns += self.slew * duration_ns


def _errors(clocks, offset, frames=600, interval_ns=16_666_667, jitter=None):
    """Converted times against the truth, ns."""
    errors = []
    for number in range(frames):
        clocks.sleep(interval_ns)
        if jitter is not None:
            clocks.ticks = iter(jitter[number])
        exposed_ns, ahead_ns = clocks.now_ns, clocks.ahead_ns
        errors.append(offset.convert(exposed_ns) - exposed_ns - ahead_ns)
    return np.array(errors)


def test_a_clock_that_stands_still_is_met_within_the_reading():
    clocks = _Clocks()
    # Three clock readings of 200 ns each, and floats of 1.7e18 ns resolve 256 ns.
    assert np.abs(_errors(clocks, ClockOffset(clocks.other, clocks.monotonic))).max() < 1000


def test_readings_that_were_interrupted_are_not_taken():
    clocks, random = _Clocks(), np.random.default_rng(3)
    jitter = np.where(random.random((600, 9)) < 0.4, random.integers(10**5, 10**8, (600, 9)), 200)
    jitter[0] = 200
    offset = ClockOffset(clocks.other, clocks.monotonic)
    # Up to 100 ms between two readings in two of five; what is taken is off by MAX_READING_NS / 2.
    assert np.abs(_errors(clocks, offset, jitter=jitter.tolist())).max() < 60_000


def test_a_slewed_clock_is_followed_and_a_set_one_at_once():
    clocks = _Clocks()
    offset = ClockOffset(clocks.other, clocks.monotonic)
    clocks.slew = 5e-4
    # Behind by what NTP slews at most in the time of smoothing, 0.5 ms.
    assert np.abs(_errors(clocks, offset)).max() < 600_000
    clocks.slew = 0.0
    for step_ns in (10 * STEP_NS, -(3600 * 10**9)):
        clocks.ahead_ns += step_ns
        assert np.abs(_errors(clocks, offset, frames=300)[[0, -1]]).max() < 600_000
