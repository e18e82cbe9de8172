"""Times of the monotonic clock become times of another one, whatever interrupts the reading."""

from __future__ import annotations

import numpy as np

from cmp_tactile_driver.sources.capture import STEP_NS, ClockOffset

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
